"""The families with a `filter_3D` column: against the published formulas, there and back, and adapted."""

import json
import math
from dataclasses import replace

import numpy as np
import ply_files
import pytest
import tiny
import torch
from mip_checkpoints import folder, splats
from oracle import brute_force

from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.cli import main
from mipmap_plugin.errors import CheckpointError, SettingsError
from mipmap_plugin.evaluation.metrics import psnr
from mipmap_plugin.formats.ply import read_ply
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.models import load_model
from mipmap_plugin.models.base import CARRIED, TrainedScale
from mipmap_plugin.models.health import LARGEST
from mipmap_plugin.models.mip import MipModel, filter_3d_of, smooth_3d
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.wrap import wrap_model

pytestmark = pytest.mark.usefixtures("few_views")

FILTERS = {"mip": ("mip", 0.1), "gof": ("mip", 0.0), "analytic": ("analytic", 0.0)}


def by_the_formulas(columns: dict[str, np.ndarray], smooth: bool = True) -> Gaussians:
    """The published formulas in float64."""
    wide = {name: torch.from_numpy(column.astype(np.float64)) for name, column in columns.items()}
    pick = lambda *names: torch.stack([wide[name] for name in names], -1)  # noqa: E731
    s, f = pick("scale_0", "scale_1", "scale_2").exp(), wide["filter_3D"] if smooth else torch.zeros_like(wide["x"])
    larger = s**2 + f[:, None] ** 2
    opacities = torch.sigmoid(wide["opacity"]) * (s.square().prod(1) / larger.prod(1)).sqrt()
    bands = [pick(*(f"f_rest_{c * 3 + j}" for c in range(3))) for j in range(3)]
    sh = torch.stack([pick("f_dc_0", "f_dc_1", "f_dc_2"), *bands], 1)
    return Gaussians(pick("x", "y", "z"), pick("rot_0", "rot_1", "rot_2", "rot_3"), larger.sqrt(), opacities, sh)


def fused() -> dict[str, np.ndarray]:
    """The columns of 3DGS that Mip-Splatting fuses its filter into."""
    return {name: column for name, column in splats().items() if name != "filter_3D"}


def ball(family: str = "mip", count: int = 60) -> MipModel:
    """The tiny scene, half of whose splats are thinner than their filter."""
    screen_filter, eps2d = FILTERS[family]
    base = tiny.gaussians(count)
    trained = TrainedScale(screen_filter, eps2d, keeps_filter=True)
    return MipModel(family, VanillaModel.from_gaussians(base, trained), base.scales.min(1).values.clamp(0.02, 0.04))


def test_t4_smoothing():
    scales = torch.tensor([[0.2, 0.1, 0.05]], dtype=torch.float64)
    smoothed, opacities = smooth_3d(scales, torch.sigmoid(scales.new_ones(1)), scales.new_tensor([0.03]))
    torch.testing.assert_close(smoothed, scales.new_tensor([[0.202237484, 0.104403065, 0.058309519]]), atol=1e-9, rtol=0)
    torch.testing.assert_close(opacities, scales.new_tensor([0.593796750]), atol=1e-9, rtol=0)


def test_smoothing_has_a_finite_gradient_everywhere():
    scales = torch.tensor([[0.0, 0.0, 0.0], [1e-30, 1e-30, 1e-30], [1e30, 1e-3, 1.0]], requires_grad=True)
    for ball in (torch.zeros(3), torch.full((3,), 1e-3)):
        smoothed, opacities = smooth_3d(scales, torch.ones(3), ball)
        gradient = torch.autograd.grad(smoothed.sum() + opacities.sum(), scales)[0]
        assert torch.isfinite(smoothed).all() and torch.isfinite(opacities).all() and torch.isfinite(gradient).all()


@pytest.mark.parametrize("family", ["mip", "gof"])
def test_splats_may_become_thinner_than_their_filter(family):
    """A zoom-out of Mip-Splatting had no closed form: it asks for thinner splats than the filter let through."""
    model = ball(family).copy()
    model.reshape(lambda splats: (splats.scales / 10, splats.opacities / 2))
    before, after = ball(family).gaussians(), model.gaussians()
    torch.testing.assert_close(after.scales, before.scales / 10)
    torch.testing.assert_close(after.opacities, before.opacities / 2)


def test_splats_with_a_filter_are_merged_as_they_look():
    model = ball().copy()
    model.rebuild(lambda splats: splats[:7])
    for name in ("means", "scales", "opacities"):
        torch.testing.assert_close(getattr(model.gaussians(), name), getattr(ball().gaussians(), name)[:7])
    assert model.filter_3d.tolist() == [0.0] * 7


@pytest.mark.parametrize("family", FILTERS)
def test_rendered_as_an_independent_sum_of_the_files_own_numbers(tmp_path, family):
    model = load_model(folder(tmp_path / "model", family))
    assert (model.family, (model.trained.screen_filter, model.trained.eps2d)) == (family, FILTERS[family])
    view = tiny.cameras(1)[0]
    image = wrap_model(model, cameras=[view]).render(view).image
    expected = brute_force(by_the_formulas(splats(), family != "analytic"), view, FILTERS[family][1], screen_filter=FILTERS[family][0])[0]
    assert expected.max() > 0.2
    torch.testing.assert_close(image.double(), expected, atol=1e-5, rtol=0)


@pytest.mark.parametrize("family", FILTERS)
@pytest.mark.parametrize("name", ["again", "again.ply"])
def test_saved_and_loaded_again(tmp_path, family, name):
    model = load_model(folder(tmp_path / "model", family))
    saved = model.save(tmp_path / name, provenance={"scale": 1})
    again = load_model(tmp_path / name)
    assert (again.family, again.trained.screen_filter, again.trained.eps2d) == (family, *FILTERS[family])
    for key, tensor in model.parameters().items():
        assert torch.equal(again.parameters()[key], tensor), key
    columns = list(read_ply(saved).columns)
    assert columns == [*ply_files.splat_names(3), "filter_3D"]  # its reader counts f_rest, and asks for filter_3D
    if name == "again":
        assert (tmp_path / name / "cfg_args").read_text() == (tmp_path / "model" / "cfg_args").read_text()


@pytest.mark.parametrize(("family", "scale", "least"), [*((family, 1 / 4, 1) for family in FILTERS), *((family, 4, 0.5) for family in FILTERS)])
def test_adapted_in_its_own_filter_it_is_closer_to_the_base(tmp_path, family, scale, least):
    base = ball(family)
    raw = {name: tensor.clone() for name, tensor in base.parameters().items()}
    wrapped = wrap_model(base, cameras=tiny.cameras())
    adapted = wrapped.adapt(scale, steps=20, extra_views=4, returns="last")
    assert quality(adapted, wrapped, scale) > quality(wrapped, wrapped, scale) + least
    assert (adapted.effects.screen_filter, adapted.effects.eps2d) == FILTERS[family]
    assert all(torch.equal(base.parameters()[name], tensor) for name, tensor in raw.items())
    loaded = wrap_model(adapted.save(tmp_path / "adapted.ply"), cameras=[])
    small = wrapped.cameras[0].zoomed(scale)
    torch.testing.assert_close(loaded.render(small).image, adapted.render(small).image, atol=1e-5, rtol=0)


def quality(model, base, scale):
    """Mean PSNR in dB of a model's images against the base's at x1; the larger of the two is shrunk."""
    decibels = []
    for view in base.cameras:
        image, truth = model.render(view.zoomed(scale)).image.clamp(0, 1), base.render(view).image.clamp(0, 1)
        size = min(image.shape[:2], truth.shape[:2])
        method = "pil-bicubic" if scale < 1 else "area"
        decibels.append(psnr(resize(image, size, method), resize(truth, size, method).clamp(0, 1)))
    return sum(decibels) / len(decibels)


def test_the_filters_go_with_their_rows_and_do_not_move():
    base = ball()
    pruning = dict(steps=12, extra_views=0, closed_form=False, merge_to=1.0, prune_every=5, min_opacity=0.3, returns="last")
    adapted = wrap_model(base, cameras=tiny.cameras()).adapt(0.25, **pruning)
    left = adapted.model.parameters()[CARRIED].detach()
    assert 0 < len(left) < len(base)
    assert torch.isin(left, base.filter_3d).all() and len(left) == len(adapted.model.parameters()["means"])


def test_filters_are_those_of_the_format():
    means, views = ball().parameters()["means"].double() + 0.05, tiny.cameras(3)
    nearest = [min((z for z in (seen_depth(mean, view) for view in views) if z), default=None) for mean in means]
    known = [z for z in nearest if z]
    expected = [(z or max(known)) / max(view.fx for view in views) * math.sqrt(0.2) for z in nearest]
    torch.testing.assert_close(filter_3d_of(means, views), torch.tensor(expected, dtype=torch.float64), atol=1e-12, rtol=1e-9)


def seen_depth(mean, view):
    """The depth of a point inside the image and 15 % around it, else None."""
    x, y, z = (view.viewmat[:3, :3] @ mean + view.viewmat[:3, 3]).tolist()
    u, v = view.fx * x / z + view.cx, view.fy * y / z + view.cy
    w, h = view.width, view.height
    return z if z > 0.2 and -0.15 * w <= u <= 1.15 * w and -0.15 * h <= v <= 1.15 * h else None


def test_rows_whose_filter_is_no_length_are_dropped(tmp_path):
    columns = splats()
    columns["filter_3D"][[3, 7, 8, 9]] = np.nan, np.inf, 2 * LARGEST, -1
    model = load_model(folder(tmp_path / "model", columns=columns))
    assert len(model) == 36 and any("4 of 40 splats were dropped" in note for note in model.notes)
    columns["filter_3D"][:] = np.nan
    with pytest.raises(CheckpointError, match="none of 40 splats"):
        load_model(folder(tmp_path / "broken", columns=columns))


def test_a_filter_of_zeros_is_an_effect_that_is_off():
    model = ball()
    assert [effect.on for effect in model.traits.effects] == [True]
    model.filter_3d.data.zero_()
    assert [effect.on for effect in model.traits.effects] == [False] and "0 for every splat" in model.traits.effects[0].reason


def test_filters_that_no_camera_sees_are_refused():
    with pytest.raises(CheckpointError, match="no training camera"):
        filter_3d_of(ball().parameters()["means"], [])


def test_a_fused_file_is_recognized_by_its_options_or_given_its_filter(tmp_path):
    """It has the columns of 3DGS: the options beside it or the user name its filter. Adapted, it is drawn as its training drew it."""
    inside = wrap_model(folder(tmp_path / "model", columns=fused()), cameras=tiny.cameras())
    assert inside.model.family == "3dgs" and (inside.effects().screen_filter, inside.effects().eps2d) == ("mip", 0.1)
    bare = load_model(ply_files.write(tmp_path / "fused.ply", fused()))
    assert bare.trained.screen_filter == "classic" and any("fused" in note for note in bare.notes)
    wrapped = wrap_model(bare, cameras=tiny.cameras(), screen_filter="mip")
    assert (wrapped.effects().screen_filter, wrapped.effects().eps2d) == ("mip", 0.1)
    adapted = wrapped.adapt(0.25, steps=0)
    assert adapted.effects == wrapped.effects() and adapted.model.trained.screen_filter == "mip"
    assert "base mip 0.1 px²; file mip 0.1 px²" in adapted.report.filters
    again = load_model(adapted.save(tmp_path / "small.ply"))
    assert (again.trained.screen_filter, again.trained.eps2d) == ("mip", 0.1)
    assert again.notes == ["the header says that the splats are to be drawn mip (0.1 px²)"]
    with pytest.raises(SettingsError, match="no screen filter 'soft'"):
        wrap_model(bare, screen_filter="soft")


def test_an_adapted_file_in_a_folder_of_mip_splatting_stays_classic(tmp_path):
    adapted = wrap_model(folder(tmp_path / "model", columns=fused()), cameras=tiny.cameras()).adapt(0.25, viewer="classic", steps=0)
    adapted.save(tmp_path / "adapted")
    assert load_model(tmp_path / "adapted").trained.screen_filter == "classic"


def test_real_files(shared_data):
    filtered = load_model(shared_data / "checkpoints" / "filter3d_2000")
    column = read_ply(shared_data / "checkpoints" / "filter3d_2000" / "point_cloud.ply").columns["filter_3D"]
    assert filtered.family == "mip" and (filtered.gaussians().scales.amin(1) >= torch.from_numpy(column.copy())[: len(filtered)] * 0.999).all()
    model = load_model(shared_data / "checkpoints" / "donut_mip_fused" / "fused.ply")
    assert model.family == "3dgs" and any("fused" in note for note in model.notes)
    view = tiny.cameras(1)[0]
    assert torch.isfinite(wrap_model(model, cameras=[view], screen_filter="mip").render(view).image).all()


def test_the_command_line_takes_the_filter(tmp_path, capsys):
    file = ply_files.write(tmp_path / "fused.ply", fused())
    assert main(["inspect", str(file), "--screen-filter", "mip"]) == 0
    assert "mip, 0.1 px²" in capsys.readouterr().out
    assert main(["adapt", str(file), "--scale", "4", "--screen-filter", "mip", "--steps", "0", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)[0]["filters"].endswith("base mip 0.1 px²; file mip 0.1 px²")


def test_any_model_can_be_rendered_with_a_3d_filter():
    base = tiny.model()
    wrapped = wrap_model(base, cameras=tiny.cameras())
    view = tiny.cameras()[0].zoomed(4)
    scales, opacities = smooth_3d(base.gaussians().scales, base.gaussians().opacities, filter_3d_of(base.gaussians().means, tiny.cameras()))
    smooth = VanillaModel.from_gaussians(replace(base.gaussians(), scales=scales, opacities=opacities))
    expected = wrap_model(smooth, cameras=tiny.cameras()).render(view, 4).image
    torch.testing.assert_close(wrapped.render(view, 4, filter_3d=True).image, expected, atol=1e-5, rtol=0)
    assert not torch.allclose(wrapped.render(view, 4).image, expected, atol=1e-2)


def test_a_3d_filter_needs_cameras():
    with pytest.raises(SettingsError, match="is computed from the cameras"):
        wrap_model(tiny.model(), cameras=[]).render(tiny.cameras()[0], filter_3d=True)
