"""Where the images are that a transforms file lists."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath

from mipmap_plugin.formats.nodes import is_file

SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp")
IMAGE_SUFFIXES = ("", *SUFFIXES, *(suffix.upper() for suffix in SUFFIXES))

# ScanNet++ has its transforms files in this folder, and the images in one beside it: as downloaded, or as its toolkit makes them.
BESIDE = "nerfstudio"
SCANNETPP = {
    "transforms.json": ("resized_images", "rgb", "images"),
    "transforms_undistorted.json": ("resized_undistorted_images", "undistorted_images"),
}

# Folder of the images in most captures, and of their smaller copies.
WHOLE, COPIES = "images", re.compile(r"images_(\d{1,9})")


def listed_images(file: Path, listed: Sequence[str]) -> tuple[list[Path | None], str, bool]:
    """The image files that a transforms file lists, each None if it is missing; where they were found if elsewhere, a sentence; if they are copies.

    They are beside the file or where ScanNet++ has them. If none of them is there, as in captures of DL3DV that were downloaded small, the largest
    copies (images_2, images_4, ...) are taken, and else those beside the file whose path ends as listed: a path of another computer (instant-ngp's
    colmap2nerf.py writes it) or from another folder. A name without a folder may also be in `images`, where LichtFeld Studio finds it.
    """
    beside = SCANNETPP.get(file.name, ()) if file.absolute().parent.name == BESIDE else ()
    for folder in (file.parent, *(file.absolute().parent.with_name(name) for name in beside)):
        found = [image_file(folder, each) for each in listed]
        if any(found):
            return found, "", False
    places, missing = [place_of(each) for each in listed], f"{file.name}: the images that it lists are not there, and the photographs are those of"
    for _, copies in sorted((int(match[1]), each) for each in file.parent.glob("images_*") if (match := COPIES.fullmatch(each.name))):
        found = [image_file(copies, str(place.relative_to(WHOLE))) if place.is_relative_to(WHOLE) else None for place in places]
        if any(found):
            return found, f"{missing} {copies.name}", True
    for ends in _ends(places):
        found = [image_file(file.parent, each) for each in ends]
        if any(found):
            return found, f"{missing} {next(each for each in found if each).parent}", False
    return [None] * len(listed), "", False


def _ends(places: Sequence[PurePosixPath]) -> Iterator[list[str]]:
    """The ends of listed paths, longest first: with the last folder, as another folder may hold other pictures by the same names."""
    if all(len(place.parts) == 1 for place in places):
        yield [f"{WHOLE}/{place}" for place in places]
    for cut in range(1, max(len(place.parts) for place in places) - 1):
        ends = ["/".join(place.parts[max(0, min(cut, len(place.parts) - 2)) :]) for place in places]
        if len({*ends}) == len({*places}):
            yield ends


def image_file(folder: Path, listed: str) -> Path | None:
    """The image file of a listed name, which may lack its suffix, or have another since (.JPG, .jpg); None if it is missing."""
    name = listed.replace("\\", "/")
    names = (f"{stem}{suffix}" for stem in dict.fromkeys((name, without_suffix(name))) for suffix in IMAGE_SUFFIXES)
    return next((folder / each for each in names if is_file(folder / each)), None)


def place_of(listed: str) -> PurePosixPath:
    """A listed name of a file, by which `./a` is the same as `a`."""
    return PurePosixPath(listed.replace("\\", "/"))


def stem_of(listed: str) -> str:
    """The name of a view whose image is absent: that of the image, without the suffix if it has one."""
    return without_suffix(place_of(listed).name)


def without_suffix(name: str) -> str:
    """A name without the suffix of an image: what is behind the last dot of `frame.0001` is none."""
    return next((name.removesuffix(suffix) for suffix in IMAGE_SUFFIXES[1:] if name.endswith(suffix)), name)
