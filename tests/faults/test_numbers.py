"""Numbers out of range: one sentence each, before any work; and nothing that is not finite is ever saved."""

import math

import numpy as np
import ply_files
import pytest
import tiny
import torch
from corpus import SAMPLES
from writers import base_and_output

from mipmap_plugin import limits
from mipmap_plugin.errors import CheckpointError, SettingsError
from mipmap_plugin.models import load_model
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.wrap import wrap_model

pytestmark = pytest.mark.usefixtures("few_views")

BAD_SCALES = [1e5, 1e308, 1e-50, 1e-10, 0, -1, math.nan, math.inf]
NO_SCALES = [True, "1/4", None, [0.25], 1j, 10**400]
BAD_COLORS = [(math.nan,) * 3, (1e30, 0, 0), (0.5, 0.5), (0, 0, 0, 0), (-0.1, 0, 0), (math.inf, 0, 0), "red", 5, (None, 0, 0), ("x", 0, 0)]
BAD_SETTINGS = [
    *({"seed": seed} for seed in (2**64, 2**63, 10**30, -1, math.nan, "x")),
    *({name: value} for name in ("target_db", "time_budget_s", "min_gain_db", "detail_weight") for value in (math.nan, math.inf)),
    *({"rates": {"means": value}} for value in (math.nan, math.inf, -1)),
    {"betas": (math.nan, 0.9)},
    {"betas": (0.9,)},
]


@pytest.fixture
def model():
    return wrap_model(tiny.model(10), cameras=tiny.cameras(2), backend="reference")


@pytest.fixture
def no_work(monkeypatch):
    monkeypatch.setattr("mipmap_plugin.adaptation.conversion.Session", lambda *_: pytest.fail("worked in vain"))


@pytest.mark.parametrize("scale", [*BAD_SCALES, *NO_SCALES])
def test_scales_that_nothing_can_be_adapted_to(model, no_work, scale):
    with pytest.raises(SettingsError, match=r"scale must be from 1e-09 to 10000, a number such as 0\.25 or 4, got "):
        model.adapt(scale)


@pytest.mark.parametrize("scale", BAD_SCALES)
def test_scales_that_nothing_can_be_drawn_at(model, scale):
    for draw in (lambda: model.render(model.cameras[0].zoomed(scale)), lambda: model.render(model.cameras[0], scale)):
        with pytest.raises(SettingsError, match="scale must be from"):
            draw()


@pytest.mark.parametrize("scale", [limits.MIN_SCALE, 1e-3, 100, limits.MAX_SCALE])
def test_what_is_saved_at_the_ends_of_the_range_is_read_again(tmp_path, scale):
    model = wrap_model(tiny.model(10), cameras=tiny.cameras(2, width=8, height=6), backend="reference")
    saved = model.adapt(scale, recipe="instant").save(tmp_path / "a.ply")
    assert len(load_model(saved)) == 10 and not any("dropped" in note for note in load_model(saved).notes)


@pytest.mark.parametrize("settings", BAD_SETTINGS, ids=str)
def test_settings_out_of_range(model, no_work, settings):
    with pytest.raises(SettingsError, match=f"setting {next(iter(settings))}"):
        model.adapt(1 / 2, **settings)


@pytest.mark.parametrize("seed", [limits.MAX_SEED, 0])
def test_the_largest_seed_is_one(model, seed):
    assert model.adapt(1 / 2, steps=1, extra_views=1, seed=seed).report.settings.seed == seed


@pytest.mark.parametrize("color", BAD_COLORS, ids=str)
def test_backgrounds_that_are_no_color(color):
    with pytest.raises(SettingsError, match="background must be three numbers from 0 to 1"):
        wrap_model(tiny.model(10), background=color)


def test_backgrounds_of_other_kinds_of_numbers_are_colors():
    for color in ([0, 1, 0.5], np.array([0, 1, 0.5]), torch.tensor([0, 1, 0.5])):
        assert wrap_model(tiny.model(10), background=color).background == (0.0, 1.0, 0.5)


# Images beyond the memory


def test_images_beyond_the_memory_are_refused_by_their_size(model, monkeypatch, no_work):
    monkeypatch.setattr(limits, "memory", lambda _: 1e6)
    with pytest.raises(SettingsError, match=r"an image of 320 x 240 px needs at least 0 GiB of memory, .*; use a smaller scale"):
        model.adapt(10, steps=1)
    with pytest.raises(SettingsError, match="an image of 640 x 480 px"):
        model.render(model.cameras[0], supersampling=20)


def test_the_memory_of_this_machine_is_known():
    assert limits.memory(torch.device("cpu")) > 2**28


# Splats that are not finite


def poisoned(values: dict[str, float]) -> VanillaModel:
    """Row 3 of ten holds a value in each of these parameters."""
    parameters = tiny.model(10).parameters()
    for name, value in values.items():
        parameters[name] = parameters[name].clone()
        parameters[name][3] = value
    return VanillaModel(parameters)


ROWS = [{"means": math.nan}, {"means": math.inf}, {"scales": math.inf}, {"scales": 50.0}, {"quats": math.nan}, {"sh0": -math.inf}]


@pytest.mark.parametrize("values", ROWS, ids=str)
def test_a_live_model_loses_the_rows_that_a_file_would_lose(tmp_path, values):
    live = poisoned(values)
    columns = live.gaussians()  # the object itself stays as it is
    read = wrap_model(live, cameras=tiny.cameras(2), backend="reference")
    assert len(read.model) == 9 and len(live) == 10 and any("1 of 10 splats was dropped" in note for note in read.model.notes)
    assert read.render(read.cameras[0]).image.isfinite().all() and columns.means.shape == (10, 3)
    dictionary = wrap_model(dict(live.parameters()), cameras=tiny.cameras(2), backend="reference")
    assert len(dictionary.model) == 9


def test_a_live_model_without_a_finite_row_is_refused():
    parameters = tiny.model(10).parameters()
    parameters["means"] = parameters["means"] * math.nan
    with pytest.raises(CheckpointError, match="this model: none of 10 splats is finite"):
        wrap_model(VanillaModel(parameters))


def test_a_live_model_of_another_family_with_a_nan_is_refused(tmp_path):
    model = load_model(SAMPLES["ply of Mip-Splatting"].make(tmp_path / "m")).copy()
    with torch.no_grad():
        model.parameters()["means"][2] = math.nan
    with pytest.raises(SettingsError, match="this MipModel holds a NaN in means of 1 of 12 rows"):
        wrap_model(model)


@pytest.mark.parametrize("name", ["ply", "cfg_args", "ply of Mip-Splatting", "ckpt of gsplat", "ckpt of splatfacto", "deform.pth", "checkpoints.pth"])
@pytest.mark.parametrize("value", [math.nan, math.inf, 1e30])
def test_nothing_that_is_not_finite_is_ever_saved(tmp_path, name, value):
    """Whatever an adaptation does to a model."""
    base, out = base_and_output(tmp_path, name)
    model = load_model(base)
    for parameter in ("means", "scales"):
        broken = model.copy()
        with torch.no_grad():
            broken.parameters()[parameter][1] = value
        with pytest.raises(SettingsError, match="so nothing is saved; adapt less boldly"):
            broken.save(out, provenance={})
    assert not out.exists()


def test_networks_that_are_not_finite_are_not_saved(tmp_path):
    model = load_model(SAMPLES["checkpoints.pth"].make(tmp_path / "base")).copy()
    with torch.no_grad():
        next(iter(model.shared_parameters().values())).fill_(math.nan)
    with pytest.raises(SettingsError, match="holds weights that are not finite, so nothing is saved"):
        model.save(tmp_path / "new", provenance={})


def test_legal_infinities_of_a_base_are_saved_as_numbers(tmp_path):
    columns = ply_files.splat_columns(6, 0)
    columns["opacity"][:2], columns["scale_1"][2] = (np.inf, -np.inf), -np.inf
    base = load_model(ply_files.write(tmp_path / "a.ply", columns))
    again = load_model(base.save(tmp_path / "b.ply", provenance={}))
    assert all(tensor.isfinite().all() for tensor in again.parameters().values()) and len(again) == 6
    for one, other in zip(vars(base.gaussians()).values(), vars(again.gaussians()).values(), strict=True):
        assert one is other is None or torch.allclose(one, other, atol=1e-30)
