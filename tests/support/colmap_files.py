"""Small COLMAP models in its text format, and photographs for them."""

import math

import numpy as np
from PIL import Image

# FORMATS §13, T2: the quaternion (w, x, y, z) and shift of a world-to-camera pose.
QUATERNION, SHIFT = (0.9, 0.1, -0.2, 0.3), (0.5, -0.25, 4.0)


def write_text_model(folder, names, model="PINHOLE", params="70 72 31 25", points=3, size=(64, 48)):
    """A model in COLMAP's text format, every image at the pose of T2; `size`: width and height, px."""
    folder.mkdir(parents=True)
    length = math.sqrt(sum(q * q for q in QUATERNION))
    pose = " ".join(str(q / length) for q in QUATERNION) + " " + " ".join(map(str, SHIFT))
    (folder / "cameras.txt").write_text(f"1 {model} {size[0]} {size[1]} {params}\n")
    (folder / "images.txt").write_text("".join(f"{i + 1} {pose} 1 {name}\n\n" for i, name in enumerate(names)))
    (folder / "points3D.txt").write_text("".join(f"{i + 1} {i} 2 3 255 0 0 0.5\n" for i in range(points)))


def write_photographs(folder, names, size=(64, 48)):
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.zeros((size[1], size[0], 3), np.uint8)).save(folder / name)


def names(count):
    """File names in an order that is not the alphabet's."""
    return [f"{(7 * i) % count:03d}.png" for i in range(count)]
