"""Bases that gsplat trains, without gsplat: its rasterizer by our own backend, and no refinement."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import tiny
import torch

sys.path.append(str(Path(__file__).parents[1] / "benchmarks"))  # its modules import one another by bare names, as scripts do

import gpu_bases

from mipmap_plugin import Camera, Effects, Gaussians, load_scene, wrap_model
from mipmap_plugin.backends import get_backend

BLACK, WHITE = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)


class NoRefinement:
    """What gsplat's strategies are called with."""

    def initialize_state(self, scene_scale):
        return {"scene_scale": scene_scale, "steps": 0}

    def step_pre_backward(self, splats, optimizers, state, step, info):
        assert splats.keys() == optimizers.keys() and info["step"] == step

    def step_post_backward(self, splats, optimizers, state, step, info):
        state["steps"] += 1


def stand_in() -> SimpleNamespace:
    calls = []

    def rasterization(means, quats, scales, opacities, colors, viewmats, lenses, width, height, **named):
        (fx, _, cx), (_, fy, cy), _ = lenses[0].tolist()
        background = tuple(named["backgrounds"][0].tolist())
        effects = Effects(named["sh_degree"], screen_filter=named["rasterize_mode"], eps2d=named["eps2d"], background=background)
        view = Camera(width, height, fx, fy, cx, cy, viewmats[0].double())
        calls.append(named)
        splats = Gaussians(means, quats, scales, opacities, colors)
        return get_backend("reference").render(splats, view, effects).image[None], None, {"step": len(calls) - 1}

    return SimpleNamespace(rasterization=rasterization, DefaultStrategy=NoRefinement, calls=calls)


@pytest.mark.parametrize(("mode", "screen_filter", "eps2d"), [("classic", "classic", 0.3), ("antialiased", "antialiased", 0.3), ("mip", "mip", 0.1)])
def test_a_base_is_trained_and_saved_with_its_filter_and_cameras(tmp_path, monkeypatch, mode, screen_filter, eps2d):
    gsplat = stand_in()
    monkeypatch.setitem(sys.modules, "gsplat", gsplat)
    monkeypatch.setattr(gpu_bases, "RANDOM_POINTS", 40)
    scene = tiny.scene(tmp_path / "scene", test=tiny.cameras(2, seed=5, split="test"), train=tiny.cameras(3))
    gpu_bases.main(scene, 12, tmp_path / "base", steps=4, mode=mode, device="cpu")
    base = wrap_model(tmp_path / "base")
    assert (base.model.trained.screen_filter, base.model.trained.eps2d, base.model.trained.background) == (screen_filter, eps2d, WHITE)
    assert [camera.split for camera in base.cameras].count("test") == 2 and {camera.width for camera in base.cameras} == {12}
    assert len(gsplat.calls) == 4 and {call["rasterize_mode"] for call in gsplat.calls} == {"classic" if mode == "classic" else "antialiased"}


def test_steps_come_nearer_to_the_photographs(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "gsplat", stand_in())
    photographs = gpu_bases.Photographs.of(load_scene(tiny.scene(tmp_path / "scene", train=tiny.cameras(3))), 12, BLACK, "cpu")
    points = torch.rand(60, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    training = gpu_bases.Training(photographs, points, "classic", 90, BLACK)

    def error() -> float:
        pairs = zip(photographs.cameras, photographs.bytes / 255, strict=True)
        with torch.no_grad():
            return sum(float((training.image(camera, 0)[0] - photograph).abs().mean()) for camera, photograph in pairs)

    before = error()
    sys.modules["gsplat"].calls.clear()
    training.run()
    assert error() < 0.8 * before


def test_each_view_comes_once_before_any_comes_again():
    photographs = gpu_bases.Photographs(tiny.cameras(3), torch.zeros(3, 2, 2, 3, dtype=torch.uint8))
    order = [photographs.cameras.index(camera) for _, camera, _ in photographs.shuffled(7)]
    assert len(order) == 7 and set(order[:3]) == set(order[3:6]) == {0, 1, 2}


def test_splats_begin_as_large_as_their_neighbors_are_far():
    splats = gpu_bases.first_splats(torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]), torch.device("cpu"))
    assert torch.allclose(splats["scales"][0].exp(), torch.ones(3)) and splats["shN"].shape == (4, 15, 3)
