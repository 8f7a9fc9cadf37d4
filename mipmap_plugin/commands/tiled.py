"""`mipmap-plugin adapt --tiles`."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import replace
from pathlib import Path

from mipmap_plugin.commands.common import print_facts
from mipmap_plugin.commands.many import Many, Request, engine, of_scene
from mipmap_plugin.commands.outputs import adapted_path
from mipmap_plugin.commands.voice import detail, say
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.jobs.base import Base
from mipmap_plugin.jobs.job import Job, Outcome


def adapt_tiled(many: Many, given: Sequence[Path], request: Request, base: Base, threads: int | None, json: bool) -> None:
    """Adapt one checkpoint to each scale and viewer in tiles. Raises SettingsError before any work, JobsFailed."""
    from mipmap_plugin.jobs.finished import finished
    from mipmap_plugin.tiles.run import adapt_in_tiles

    if many.tiles is None or many.is_list(given) or many.shard is not None:
        raise SettingsError("--tiles cuts one checkpoint; give that one, without --list and --shard")
    if many.send_files:
        raise SettingsError("--tiles needs a folder that all workers see, so that files are not sent; leave --send-files out")
    settings = dict(request.settings)
    recipe, several = settings.pop("recipe"), len(request.targets) > 1

    def run(jobs: Sequence[Job]) -> Generator[Outcome, None, None]:
        return engine(many, jobs, threads)

    reports = []
    for scale, viewer in request.targets:
        target = adapted_path(given[0], request.output, scale, viewer, several=several).absolute()
        job = Job(_absolute(base, given[0]), target, scale, viewer, recipe, settings, of_scene(request.images, given[0]), request.overwrite)
        if many.skip_existing and (before := finished(job)):
            file, facts = before
            reports.append({"file": str(file), **facts})
            if not json:
                say(f"{file}: finished before")
            continue
        joined = adapt_in_tiles(job, many.tiles, run, threads)
        report = joined.report
        before_db, after_db = report.psnr_before(), report.psnr_after()
        gain = f"{before_db:.2f} -> {after_db:.2f} dB on views that nothing was adapted to" if before_db and after_db else f"holds {report.returned}"
        splats = f"{report.gaussians_before:,} -> {report.gaussians_after:,} splats"
        if not json:
            say(f"x{scale:g}{f' in {viewer}' if viewer else ''}, {many.tiles} tiles: {gain}, {splats}, {report.seconds['total']:.1f} s")
            say(str(joined.file))
            detail(f"  holds {report.returned}; {report.views}; {report.filters}; backend {report.backend}")
        reports.append({"file": str(joined.file), **joined.facts()})
    if json:
        print_facts(reports, json)


def _absolute(base: Base, checkpoint: Path) -> Base:
    return replace(base, checkpoint=checkpoint.absolute(), cameras=of_scene(base.cameras, checkpoint))
