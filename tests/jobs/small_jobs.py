"""Jobs that are done in a moment."""

from dataclasses import replace

import tiny

from mipmap_plugin.jobs.base import Base
from mipmap_plugin.jobs.job import Job
from mipmap_plugin.scenes import write_cameras

QUICK = ["--views", "given", "--steps", "2"]


def job_of(tmp_path, **changes):
    base = tmp_path / "base.ply"
    if not base.exists():
        tiny.ply(base)
        write_cameras(tmp_path / "cameras.json", tiny.cameras(3))
    settings = {"steps": 0, "seed": 0, "views": "given"}
    return replace(Job(Base(base, tmp_path / "cameras.json"), tmp_path / "out.ply", 0.5, settings=settings), **changes)
