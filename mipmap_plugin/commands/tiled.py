"""`mipmap-plugin adapt --tiles`."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from mipmap_plugin.commands.common import print_json, starting
from mipmap_plugin.commands.many import Many, Request, engine, finished_before, jobs_of
from mipmap_plugin.commands.voice import detail, say
from mipmap_plugin.errors import SettingsError, plural
from mipmap_plugin.formats.here import from_here
from mipmap_plugin.jobs.base import Base
from mipmap_plugin.jobs.job import Job

if TYPE_CHECKING:
    from mipmap_plugin.tiles.run import Joined


def adapt_tiled(many: Many, given: Sequence[Path], request: Request, base: Base, threads: int | None, json: bool) -> None:
    """Adapt one checkpoint to each scale and viewer in tiles. Raises SettingsError before any work, JobsFailed."""
    with starting():
        from mipmap_plugin.tiles.plan import unlock
        from mipmap_plugin.tiles.run import adapt_all_in_tiles

    if many.tiles is None or many.is_list(given) or many.shard is not None:
        raise SettingsError("--tiles cuts one checkpoint; give that one, without --list and --shard")
    if many.send_files:
        raise SettingsError("--tiles needs a folder that all workers see, so that files are not sent; leave --send-files out")

    jobs = jobs_of(given[0], request, base)
    engine(many, jobs, threads)  # begins nothing, and raises what is wrong with its options before the scene is cut
    skip = many.skip_existing or (len(jobs) > 1 and not request.overwrite)  # as in a list
    reports = finished_before(jobs, json, may_load=False) if skip else {}  # the base may not fit into memory
    left = [job for job in jobs if job.target not in reports]
    unlock([job for job in jobs if job.target in reports])
    try:
        for job, joined in zip(left, adapt_all_in_tiles(left, many.tiles, partial(engine, many, threads=threads), threads), strict=True):
            reports[job.target] = {"file": str(joined.file), **joined.facts()}
            if not json:
                _say(job, many.tiles, joined)
    except KeyboardInterrupt as interrupt:
        again = " with --skip-existing" if len(jobs) > 1 and not skip else ""
        raise KeyboardInterrupt(f"interrupted; run the same command again{again} to go on where it stopped") from interrupt
    if json:
        print_json([reports[job.target] for job in jobs])


def _say(job: Job, tiles: int, joined: Joined) -> None:
    report = joined.report
    splats = f"{report.gaussians_before:,} -> {plural(report.gaussians_after, 'splat')}"
    viewer = f" in {job.viewer}" if job.viewer else ""
    say(f"x{job.scale:g}{viewer}, {plural(tiles, 'tile')}: {report.gain()}, {splats}, {report.seconds['total']:.1f} s")
    say(from_here(joined.file))
    detail(f"  holds {report.returned}; {report.views}; {report.filters}; backend {report.backend}")
