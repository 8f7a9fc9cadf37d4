"""Where the supported projects keep their files, in a model folder and beside the file that holds the splats."""

from __future__ import annotations

import os
import re
from pathlib import Path

from mipmap_plugin.formats.atomic import named

# Checkpoints in the result folders of projects that save with torch: subfolder, and pattern of the file names.
GSPLAT = ("ckpts", r"ckpt_(?P<step>\d+)(?:_rank(?P<rank>\d+))?\.pt")
SPLATFACTO = ("nerfstudio_models", r"step-(?P<step>\d+)\.ckpt")

# Subfolders in which the supported projects keep parts of a checkpoint.
PARTS = ("point_cloud", "deform", GSPLAT[0], SPLATFACTO[0])

# What is appended to the name of an adapted file, for the report that lies beside it.
REPORT = ".adaptation.json"

# What is appended to it for the state of an unfinished run, and to that for the state of the conversion before the run.
STATE, CONVERTED = ".resume", ".x1"

# The same for the page that shows what came out, and for the folder of unfinished tiles, with what says in it what they belong to.
PAGE_ENDING, TILES, PLAN = ".report.html", ".tiles", "plan.json"

# The page in the folder of a ladder or of a tradeoff.
PAGE = "report.html"

# How a page says that it is one (`pages/report.html`), and within how many bytes.
PAGE_TITLE, HEAD = b"<title>mipmap_plugin</title>", 1000

# What lies in the folder of a ladder of levels and says what its files are (`levels.manifest`).
MANIFEST = "levels.json"

# Which files of a model folder are the networks of a moving scene.
NETWORKS = {"4dgs": "point_cloud/*iteration_*/deformation.pth", "deformable": "deform/iteration_*/deform.pth"}


def around(file: Path) -> tuple[Path | None, int | None]:
    """The model folder and the iteration of a file: `<folder>` and N in INRIA's `<folder>/point_cloud/iteration_<N>/point_cloud.ply`; the
    parent of a subfolder with a known name; or the file's own folder if it has a cfg_args."""
    place = file.absolute().parent
    number = re.fullmatch(r"(?:coarse_)?iteration_(\d+)", place.name)
    if number and place.parent.name == "point_cloud":
        return place.parent.parent, int(number[1])
    if place.name in (GSPLAT[0], SPLATFACTO[0]) and file.suffix != ".ply":
        return place.parent, None
    return (place if (place / "cfg_args").is_file() else None), None


def network_of(ply: Path, family: str) -> Path:
    """The network of a moving scene: that of the same iteration as the splats, the only one that fits them."""
    place = ply.absolute().parent
    return place / "deformation.pth" if family == "4dgs" else place.parent.parent / "deform" / place.name / "deform.pth"


def is_coarse(ply: Path) -> bool:
    """Whether the PLY is of the first (coarse) stage of 4D Gaussians, in which nothing moves."""
    return ply.absolute().parent.name.startswith("coarse_iteration_")


def state_path(output: Path) -> Path:
    """The path of the state of a run whose model is to be saved to `output`."""
    output = named(output)
    return output.with_name(output.name + STATE)


def conversion_state(state: Path) -> Path:
    """The path of the state of the conversion before a run with that `state` (`adaptation.conversion`)."""
    return state.with_name(state.name + CONVERTED)


def has_report(file: Path) -> bool:
    """Whether the report of an adaptation lies beside a file; none does where its name would be too long."""
    return os.path.isfile(file.with_name(file.name + REPORT))


def page_at(path: Path) -> list[Path]:
    """The page at `path`, if there is one: it goes with what it shows."""
    if not path.is_file():
        return []
    with path.open("rb") as file:
        return [path] if PAGE_TITLE in file.read(HEAD) else []


def page_of(file: Path) -> list[Path]:
    """The page that shows the file or folder at this path, if both are there: it goes when that is replaced."""
    file = named(file)
    return page_at(file.with_name(file.name + PAGE_ENDING)) if file.exists() else []
