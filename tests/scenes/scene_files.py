"""Entries and images of scene files."""

import json

from PIL import Image

# The world-to-camera rotation of quaternion (0.9, 0.1, -0.2, 0.3), normalized, and a translation, evaluated by hand.
ROTATION = [[0.726315789, -0.610526316, -0.315789474], [0.526315789, 0.789473684, -0.315789474], [0.442105263, 0.063157895, 0.894736842]]
TRANSLATION = [0.5, -0.25, 4.0]


def entry(**changes) -> dict:
    turned = [list(column) for column in zip(*ROTATION, strict=True)]
    known = {"id": 0, "img_name": "a", "width": 64, "height": 48, "position": [-2.0, 0.25, -3.5], "rotation": turned, "fy": 72.0, "fx": 70.0}
    return {key: value for key, value in {**known, **changes}.items() if value is not None}


def frame(**changes) -> dict:
    pose = [[1, 0, 0, 1.0], [0, 1, 0, 2.0], [0, 0, 1, 3.0], [0, 0, 0, 1]]
    return {key: value for key, value in {"file_path": "./train/r_0", "transform_matrix": pose, **changes}.items() if value is not None}


def write_json(path, content):
    path.write_text(json.dumps(content))
    return path


def save_image(path, width=8, height=6, mode="RGB"):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new(mode, (width, height)).save(path)
    return path
