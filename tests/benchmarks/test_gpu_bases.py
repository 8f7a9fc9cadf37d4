"""Bases that gsplat trains, without gsplat: its rasterizer by our own backend, and no refinement."""

import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import gpu_bases
import pytest
import tiny
import torch

from mipmap_plugin import Camera, Effects, Gaussians, load_scene, wrap_model
from mipmap_plugin.backends import get_backend


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


@pytest.fixture
def gsplat(monkeypatch):
    """The stand-in, on a processor."""
    module = stand_in()
    monkeypatch.setitem(sys.modules, "gsplat", module)
    monkeypatch.setattr(gpu_bases, "missing", list)
    monkeypatch.setattr(gpu_bases, "DEVICE", "cpu")
    monkeypatch.setattr(gpu_bases, "RANDOM_POINTS", 40)
    return module


@pytest.mark.parametrize(("mode", "screen_filter", "eps2d"), [("classic", "classic", 0.3), ("antialiased", "antialiased", 0.3), ("mip", "mip", 0.1)])
def test_a_base_is_trained_and_saved_with_its_filter_and_cameras(tmp_path, gsplat, capsys, mode, screen_filter, eps2d):
    scene = tiny.scene(tmp_path / "scene", test=tiny.cameras(2, seed=5, split="test"), train=tiny.cameras(3))
    gpu_bases.main(scene, 12, tmp_path / "base", steps=4, mode=mode)
    assert "no points to begin at: 40 lie at random" in capsys.readouterr().err
    base = wrap_model(tmp_path / "base")
    assert (base.model.trained.screen_filter, base.model.trained.eps2d, base.model.trained.background) == (screen_filter, eps2d, gpu_bases.WHITE)
    assert [camera.split for camera in base.cameras].count("test") == 2 and {camera.width for camera in base.cameras} == {12}
    assert len(gsplat.calls) == 4 and {call["rasterize_mode"] for call in gsplat.calls} == {"classic" if mode == "classic" else "antialiased"}


def test_views_that_are_trained_on_are_not_for_testing(tmp_path, gsplat):
    views = tiny.cameras(9)
    scene = tiny.scene(tmp_path / "scene", train=views, test=views)
    (scene / "transforms_test.json").unlink()
    gpu_bases.main(scene, 12, tmp_path / "base", steps=1)
    assert {camera.split for camera in wrap_model(tmp_path / "base").cameras} == {"train"}


def test_cameras_that_the_file_cannot_tell_apart_are_warned_of(tmp_path, gsplat):
    tests = [replace(camera, name=f"other_{camera.name}") for camera in tiny.cameras(3, seed=5, split="test")]
    with pytest.warns(UserWarning, match="cannot say which views are for testing"):
        gpu_bases.main(tiny.scene(tmp_path / "scene", train=tiny.cameras(3), test=tests), 12, tmp_path / "base", steps=1)


WRONG = {
    "no such scene": (dict(scene="missing"), "missing"),
    "no photographs": (dict(scene="unseen"), "has 0 photographs to train on"),
    "one place": (dict(scene="alone"), "has 1 photographs to train on; training needs some that were taken from different places"),
    "two shapes": (dict(scene="shapes"), "its photographs, 12 px wide, are 9 to 12 px high; give some of one shape"),
    "no width": (dict(width=0), "--width and --steps must be at least 1, got 0 and 4"),
    "no steps": (dict(steps=0), "--width and --steps must be at least 1, got 12 and 0"),
    "an output that exists": (dict(output="scene"), "scene exists already; remove it, or choose another path"),
    "an output that is a file": (dict(output="base.ply"), "base.ply is the name of a file; a base is a folder"),
    "an output within a file": (dict(output="file/base"), "file is a file, not a folder; choose another path"),
    "a gray background": (dict(background=(0.5, 0.5, 0.5)), "--background must be 1 1 1 or 0 0 0, the two that cfg_args can say, got 0.5 0.5 0.5"),
}  # fmt: skip


@pytest.mark.parametrize(("given", "sentence"), WRONG.values(), ids=WRONG)
def test_what_cannot_be_trained_ends_with_a_sentence_before_the_training(tmp_path, monkeypatch, capsys, gsplat, given, sentence):
    monkeypatch.chdir(tmp_path)
    Path("file").touch()
    for name, views in (("scene", tiny.cameras(3)), ("unseen", []), ("alone", tiny.cameras(1))):
        tiny.scene(Path(name), train=views)
    tiny.scene(Path("shapes"), train=[*tiny.cameras(2), replace(tiny.cameras(1, seed=3, height=tiny.WIDTH)[0], name="high")])
    request = dict(scene="scene", width=12, output="base", steps=4) | given
    with pytest.raises(SystemExit) as ending:
        gpu_bases.main(**request | {name: Path(request[name]) for name in ("scene", "output")})
    printed = capsys.readouterr().err
    assert ending.value.code == 2 and printed.startswith("benchmarks/gpu_bases.py: ") and sentence in printed and printed.count("\n") == 1
    assert not gsplat.calls and not Path("base").exists()


def test_without_gsplat_or_a_gpu_it_says_what_it_needs(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(gpu_bases, "missing", lambda: ["it needs gsplat", "it needs a CUDA GPU"])
    with pytest.raises(SystemExit) as ending:
        gpu_bases.main(tmp_path, 12, tmp_path / "base")
    assert ending.value.code == 2 and capsys.readouterr().err == "benchmarks/gpu_bases.py: it needs gsplat; it needs a CUDA GPU\n"


def test_steps_come_nearer_to_the_photographs(tmp_path, gsplat):
    photographs = gpu_bases.Photographs.of(load_scene(tiny.scene(tmp_path / "scene", train=tiny.cameras(3))), 12, gpu_bases.BLACK, "cpu")
    points = torch.rand(60, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    training = gpu_bases.Training(photographs, points, "classic", 90, gpu_bases.BLACK)

    def error() -> float:
        pairs = zip(photographs.cameras, photographs.bytes / 255, strict=True)
        with torch.no_grad():
            return sum(float((training.image(camera, 0)[0] - photograph).abs().mean()) for camera, photograph in pairs)

    before = error()
    gsplat.calls.clear()
    training.run()
    assert error() < 0.8 * before


def test_each_view_comes_once_before_any_comes_again():
    photographs = gpu_bases.Photographs(tiny.cameras(3), torch.zeros(3, 2, 2, 3, dtype=torch.uint8))
    order = [photographs.cameras.index(camera) for _, camera, _ in photographs.shuffled(7)]
    assert len(order) == 7 and set(order[:3]) == set(order[3:6]) == {0, 1, 2}


def test_splats_begin_as_large_as_their_neighbors_are_far():
    splats = gpu_bases.first_splats(torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]), torch.device("cpu"))
    assert torch.allclose(splats["scales"][0].exp(), torch.ones(3)) and splats["shN"].shape == (4, 15, 3)


def test_neighbors_that_are_far_from_the_origin_are_as_near():
    points = torch.rand(40, 3, generator=torch.Generator().manual_seed(0))
    near, far = (gpu_bases.first_splats(points + shift, torch.device("cpu"))["scales"].exp() for shift in (0, 1000))
    assert torch.allclose(near, far, rtol=0.01)


def test_too_few_points_are_replaced_by_random_ones(monkeypatch):
    monkeypatch.setattr(gpu_bases, "RANDOM_POINTS", 40)
    assert len(gpu_bases.first_splats(torch.zeros(3, 3), torch.device("cpu"))["means"]) == 40
