"""The benchmarks' own parts: scenes, counts and the yardstick are what the tables say that they are."""

import importlib.util
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import real_bases
import tiny
import torch
import unbounded
from ablations import ABLATIONS
from backends import facts, joined
from measure import Scaling, Speed, Spread, Timing
from rows import write_page
from scenes import make
from tables import Row, Rows
from workloads import Size, Variant, activated, count_pairs, effects_of, from_scene, from_variant, split_into
from zoom_in import kept as kept_with_networks
from zoom_in_plot import draw

from mipmap_plugin.backends import get_backend
from mipmap_plugin.evaluation.evaluate import Row as Judged
from mipmap_plugin.evaluation.measure import views_seen
from mipmap_plugin.evaluation.report import records
from mipmap_plugin.formats.atomic import write_json
from mipmap_plugin.recipes import recipe as make_config
from mipmap_plugin.splatting.projection import project
from mipmap_plugin.splatting.rotations import rotations
from mipmap_plugin.wrap import wrap_model

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


def brute_force_pairs(gaussians, camera):
    """Every splat at every pixel, from the inverse covariance."""
    p = project(gaussians, camera, 0.2)
    covariance = torch.stack([p.xx + 0.3, p.xy, p.xy, p.yy + 0.3], -1).unflatten(-1, (2, 2))
    y, x = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
    gap = torch.stack([x, y], -1).flatten(0, 1)[None] - p.means2d[:, None]
    q = torch.einsum("npi,nij,npj->np", gap, covariance.inverse(), gap)
    alpha = gaussians.opacities[:, None] * torch.exp(-q / 2)
    return int(((alpha >= 1 / 255) & (p.depths > 0.2)[:, None]).sum())


def test_pairs_are_counted_exactly():
    work = from_scene("T")
    assert count_pairs(activated(work.raw), work.camera) == brute_force_pairs(activated(work.raw).to(dtype=torch.float64), work.camera)


def moments(gaussians):
    """Mass, mean and covariance of all splats together."""
    mass = gaussians.opacities * gaussians.scales.prod(1)
    mean = (mass[:, None] * gaussians.means).sum(0) / mass.sum()
    axes = rotations(gaussians.quats) * gaussians.scales[:, None]
    gap = gaussians.means - mean
    covariance = (mass[:, None, None] * (axes @ axes.mT + gap[:, :, None] * gap[:, None])).sum(0) / mass.sum()
    return mass.sum(), mean, covariance


def test_a_larger_stand_in_has_the_same_moments():
    splats = tiny.gaussians(20).to(dtype=torch.float64)
    larger = split_into(splats, 130)
    assert len(larger) == 130
    for one, other in zip(moments(splats), moments(larger), strict=True):
        torch.testing.assert_close(one, other)


@pytest.mark.parametrize(("student", "pixels"), [(True, (6, 8)), (False, (24, 32))])
def test_users_scenes_are_as_an_adaptation_sees_them(tmp_path, student, pixels):
    work = from_variant(Variant(tiny.folder(tmp_path / "base"), 1 / 4, student))
    assert work.camera.size == pixels and work.pairs > 0


def test_scenes_are_those_that_peers_were_measured_on():
    file = BENCHMARKS.parents[1] / "shared" / "bench" / "scenes.py"
    if not file.exists():
        pytest.skip("the peers' generator lies beside the author's repository only")
    spec = importlib.util.spec_from_file_location("peers_scenes", file)
    peers = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(peers)
    theirs, _, weights = peers.make("A")
    ours = make("A")
    assert np.array_equal(weights, ours.weights)
    for name, array in {**ours.raw, "logit_opac": ours.raw["logits"]}.items():
        assert name == "logits" or np.array_equal(theirs[name], array), name


def test_growth_scenes_share_their_splats():
    few, many = make("P1"), make("P10")
    assert all(np.allclose(few.raw[name], many.raw[name], atol=1e-5) for name in few.raw)


def test_gsplat_twins_draw_what_the_reference_draws():
    pytest.importorskip("gsplat.cuda._torch_impl", reason="gsplat is in the test extra")
    from gsplat_twins import GsplatTwins

    work = from_scene("T")
    images, grads = [], []
    for backend in (get_backend("reference"), GsplatTwins()):
        leaves = {name: tensor.clone().requires_grad_() for name, tensor in work.raw.items()}
        gaussians = activated(leaves)
        image = backend.render(gaussians, work.camera, effects_of(gaussians)).image
        (image * work.weights).sum().backward()
        images.append(image.detach())
        grads.append(torch.cat([leaf.grad.flatten() for leaf in leaves.values()]))
    torch.testing.assert_close(images[1], images[0], atol=1e-4, rtol=0)
    assert (grads[1] - grads[0]).norm() < 1e-4 * grads[0].norm()


@pytest.mark.parametrize("name", ABLATIONS)
def test_an_ablation_varies_one_thing_of_its_recipe(name):
    recipe, variants = ABLATIONS[name]
    made = [make_config(recipe, 1 / 4, **settings) for settings in variants.values()]
    assert len({config.model_dump_json() for config in made}) == len(made)


def test_a_measurement_in_pieces_keeps_the_others(tmp_path):
    def row(backend: str, scene: str, ms: float) -> Row:
        timing = Timing(Spread.of([ms]), Spread.of([ms]), 1)
        return Row(backend, Size(scene, 10, 8, 8, 100), Speed(timing, timing, 1.0), Scaling(timing, timing, Spread.of([1.7]), Spread.of([1.9])))

    older = [row("cpu", "A", 1.0), row("reference", "A", 30.0), row("cpu", "lego", 2.0)]
    write_json(tmp_path / "facts.json", facts(Rows(older), [older[0].size, older[2].size], {}), overwrite=True)
    fresh = [row("cpu", "A", 1.5), row("cpu", "B", 3.0)]
    rows, sizes = joined(tmp_path / "facts.json", fresh, [one.size for one in fresh])
    assert rows == [fresh[0], older[1], fresh[1], older[2]]
    assert [size.name for size in sizes] == ["A", "B", "lego"]


def judged(name: str) -> Judged:
    return Judged(name, 0.5, "P3", 30.0, None, 1.0, 2.0, 100)


def test_rows_of_recipes_that_are_not_measured_again_are_kept_and_no_others(tmp_path):
    names = ["base", "base, resized", "window, 2 x 2 samples", "paper, 3 of 25 judged views adapted to", "default, scored", "thorough, held out"]
    write_json(tmp_path / "lego.json", records([judged(name) for name in names]), overwrite=True)
    assert [row.name for row in real_bases.kept(tmp_path / "lego.json", ("default",))] == [names[3], names[5]]
    assert real_bases.kept(tmp_path / "chair.json", ("default",)) == []


def test_a_page_has_every_base_under_its_name(tmp_path):
    for base, name in (("lego", "paper"), ("chair", "default")):
        write_json(tmp_path / f"{base}.json", records([judged(name)]), overwrite=True)
    write_page(tmp_path / "page.md", "# What\n", tmp_path.glob("*.json"))
    intro, chair, lego = (tmp_path / "page.md").read_text().split("## ")
    assert intro == "# What\n\n" and "default" in chair.removeprefix("chair\n") and "paper" in lego.removeprefix("lego\n")


@pytest.fixture
def captures(tmp_path, monkeypatch):
    """What `unbounded.py` measures of one small capture; by photographs where they are asked for."""
    tiny.folder(tmp_path / "checkpoints" / "ball", tiny.cameras(6))
    tiny.scene(tmp_path / "images", test=[replace(view, split="test") for view in tiny.cameras(6)])
    for png in (tmp_path / "images" / "test").glob("*.png"):
        png.rename(png.with_suffix(".jpg"))  # Pillow looks at the bytes

    def measured(scale, photographs=None):
        monkeypatch.setattr(unbounded, "CAPTURES", {"ball": unbounded.Capture("ball", (scale,), every=3, photographs=photographs)})
        monkeypatch.setattr(unbounded, "recipes", lambda capture, scale: {"instant": dict(recipe="instant")})
        unbounded.main(tmp_path, tmp_path)
        return [Judged(**row) for row in json.loads((tmp_path / "unbounded" / f"ball_x{scale:g}.json").read_text())]

    return measured


def test_a_capture_has_every_row_under_every_truth_but_the_truth_itself(captures, tmp_path):
    rows = captures(1 / 4, "test")
    names = {protocol: [row.name for row in rows if row.protocol == protocol] for protocol in ("P3", "N x N samples", "base, bicubic")}
    free = ["base", "scaled", "window", "supersampling, 2 x 2", "supersampling, 4 x 4", "window, 2 x 2 samples", "base, resized"]
    assert names["P3"] == [*free, "instant"]
    assert names["N x N samples"] == [*free[:4], free[5], "instant"]
    assert names["base, bicubic"] == [*free[:6], "instant"]
    assert {row.adapted_on for row in rows if row.name == "instant"} == {"4 train views and 100 around them"}
    assert "## ball_x0.25" in (tmp_path / "unbounded.md").read_text()


def test_a_zoom_in_of_a_capture_is_shrunk_and_compared_with_the_base(captures):
    rows = {row.name: row for row in captures(2.0)}
    assert list(rows) == ["base", "scaled", "window", "instant"] and {row.protocol for row in rows.values()} == {"base, bicubic"}
    assert rows["scaled"].psnr_db > rows["base"].psnr_db


def test_held_out_views_of_a_capture_come_in_the_order_of_names(tmp_path):
    base = wrap_model(tiny.model(), cameras=tiny.cameras(9)[::-1])
    judged, others = unbounded.split(base, unbounded.Capture("ball", (0.25,), every=4))
    assert [view.name for view in judged] == ["view_0", "view_4", "view_8"] and len(others) == 6


def test_smaller_cameras_of_a_capture_are_those_of_its_base():
    """Views of another zoom would get base images of the size of the training, so that the base were its own truth at the new scale."""
    base = wrap_model(tiny.model(), cameras=tiny.cameras(4))
    judged, others = unbounded.split(base, unbounded.Capture("ball", (2.0,), every=2, share=0.5))
    assert {(view.width, view.zoom) for view in (*judged, *others)} == {(base.cameras[0].width // 2, 1.0)}


def test_a_capture_without_cameras_is_judged_on_views_that_no_seed_of_adapting_draws():
    base = wrap_model(tiny.model(), cameras=[])
    judged, others = unbounded.split(base, unbounded.Capture("ball", (0.25,)))
    adapted = base.adapt(0.25, recipe="instant", cameras=others or None)
    assert len(judged) == unbounded.ORBIT_VIEWS and others == [] and views_seen(judged, adapted.adapted_to) == []


def zoomed_in(name, psnr_db=27.0, lpips=0.08, scale=2.0):
    return Judged(name, scale, "P3", psnr_db, 0.9, 1.0, 10.0, 100, lpips=lpips, lpips_label="LPIPS", scene="lego")


def test_only_rows_with_networks_of_a_scale_are_kept(tmp_path):
    file = tmp_path / "lego_100.json"
    assert kept_with_networks(file, 2) == []
    rows = [zoomed_in("base"), zoomed_in("default, crispness 0"), zoomed_in("default + X2.pt"), zoomed_in("default + X4.pt", scale=4.0)]
    write_json(file, records(rows), overwrite=True)
    assert [row.name for row in kept_with_networks(file, 2)] == ["default + X2.pt"]


def test_crispness_is_drawn(tmp_path):
    pytest.importorskip("matplotlib")
    crisp = [zoomed_in(f"{kind}, crispness {each}", 26 - each, 0.09 - 0.02 * each) for kind in ("closed form", "default") for each in (0, 0.5, 1)]
    draw(tmp_path / "front.png", {"lego_100": [zoomed_in("base", 22.0), *crisp, zoomed_in("enlarged by bicubic", lpips=0.16)]})
    assert (tmp_path / "front.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("only", [(), ("lego_300",)])
def test_bases_that_are_not_there_are_said_to_be(tmp_path, capsys, only):
    with pytest.raises(SystemExit) as ending:
        real_bases.main(tmp_path, tmp_path, only)
    assert ending.value.code == 2 and f"{tmp_path} holds no such base; known are lego_200" in capsys.readouterr().err
