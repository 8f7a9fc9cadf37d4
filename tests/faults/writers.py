"""Samples of what is saved, one of each writer: what is adapted from them, where that goes, and what a folder holds."""

import hashlib
from pathlib import Path

import tiny
from corpus import SAMPLES

from mipmap_plugin.adaptation.adapted import Adapted
from mipmap_plugin.wrap import wrap_model

WRITERS = ["ply", "cfg_args", "ply of Mip-Splatting", "checkpoints.pth", "opacity_mlp.pt", "deform.pth", "deformation.pth"]
WRITERS += ["ckpt of gsplat", "ckpt of splatfacto"]


def base_and_output(folder: Path, name: str) -> tuple[Path, Path]:
    """A sample of a writer, and a path for what is adapted from it, in a folder of its own that is not there yet."""
    base = SAMPLES[name].make(folder / "base")
    return base, folder / "out" / ("new.ply" if base.suffix == ".ply" else "new")


def adapted(path: Path, scale: float) -> Adapted:
    return wrap_model(path, cameras=tiny.cameras(2, width=8, height=6)).adapt(scale, recipe="instant")


def contents(folder: Path) -> dict[str, str]:
    """The hash of each file, by its name in the folder."""
    found = sorted(path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in found}
