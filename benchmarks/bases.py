"""Real bases of the folder DATA, and what judges them: checkpoints/bases/<scene>_<px>, 3DGS model folders, and images/<scene> of NeRF-Synthetic."""

from __future__ import annotations

from pathlib import Path

from mipmap_plugin import load_scene
from mipmap_plugin.evaluation.evaluate import Evaluator
from mipmap_plugin.evaluation.judged import photographed_views
from mipmap_plugin.evaluation.perceptual import Perceptual
from mipmap_plugin.evaluation.protocols import PROTOCOLS
from mipmap_plugin.scenes import Scene
from mipmap_plugin.wrap import Wrapped


def photographs_of(data: Path, base: str) -> Scene:
    """The scene that a base was trained on, such as lego of lego_200."""
    return load_scene(data / "images" / base.split("_")[0])


def judge_of(wrapped: Wrapped, data: Path, base: str, most: int | None = None, perceptual: Perceptual | None = None) -> Evaluator:
    """What judges a base by its test photographs, at most the first `most`, by protocol P3."""
    return Evaluator(photographed_views(wrapped, wrapped.place(photographs_of(data, base)))[:most], PROTOCOLS["P3"], perceptual, base)
