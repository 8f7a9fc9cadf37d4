"""Photographs that are of another scene than the checkpoint, or of a smaller size: all figures would be of no use, or of another scale."""

from __future__ import annotations

from collections.abc import Sequence

from mipmap_plugin.adaptation.target.other_world import doubt_about
from mipmap_plugin.adaptation.target.photographs import names_of
from mipmap_plugin.evaluation.judged import JudgedView
from mipmap_plugin.evaluation.protocols import TruthView
from mipmap_plugin.models.inria_folder import read_options
from mipmap_plugin.scenes import Scene
from mipmap_plugin.scenes.training_options import photographs_folder, trained_size
from mipmap_plugin.wrap import Wrapped

# px: a size that was rounded in other ways is no other size.
ROUNDING = 4


def of_another_scene(model: Wrapped, views: Sequence[TruthView]) -> str:
    """That the base does not show what the photographs do, in a sentence (`doubt_about`).

    Whatever scale they are judged at: pictures of a few pixels are like each other whatever they show. "" if it does, or if that was told already.
    """
    if model.doubted:
        return ""
    judged = {view.camera: view for view in views if isinstance(view, JudgedView)}
    masks = ", whose transparent parts count as background" if any(view.transparent for view in judged.values()) else ""
    option, exposures = f"--images{masks}", model.model.traits.exposures
    return doubt_about([*judged], lambda camera: judged[camera].photograph, model.render, model.background, option, exposures)


def of_another_size(model: Wrapped, scene: Scene) -> str:
    """That a training on these photographs has smaller pictures than the base's cameras, in a sentence; "" if it has not.

    A cameras.json states the size that COLMAP saw, which the photographs of Tanks and Temples in 3DGS's own download have not:
    they are half of it (graphdeco-inria/gaussian-splatting, issue 692).
    Larger ones are no such doubt: a zoom-in is judged against the photographs that smaller ones for the training were made from.
    """
    cfg = read_options(model.model.folder)[0]
    whole = (view for view, file in scene.images.items() if file.parent.name == photographs_folder(cfg) and file not in scene.lenses)
    view = next(whole, None)
    if not cfg or view is None:
        return ""
    own, names = scene.image_size(view), names_of(view)
    trained, there = trained_size(*own, {**cfg, "images": "", "ds": 1}), [base for base in model.cameras if names_of(base)[0] in names]
    if not there or any(max(base.width - trained[0], base.height - trained[1]) <= ROUNDING for base in there):
        return ""
    said, found, expected = (f"{width} x {height} px" for width, height in ((there[0].width, there[0].height), own, trained))
    doubt = f"the base's cameras are of {said}, but a training on the photographs (of {found}) has pictures of {expected}"
    return f"{doubt}: if these are what it was trained on, x1 is another scale than is taken here; add --cameras {scene.source}"
