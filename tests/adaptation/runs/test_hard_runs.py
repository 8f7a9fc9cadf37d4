"""Hard cases end well, and what cannot be served is refused in a sentence."""

from dataclasses import replace
from decimal import Decimal
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import tiny
import torch
from brief_runs import is_finite, wrapped

from mipmap_plugin.adaptation.report import PeakMemory
from mipmap_plugin.adaptation.session import Session
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.errors import BackendUnavailable, SettingsError
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.wrap import wrap_model

# Hard cases


def black_on_black() -> VanillaModel:
    splats = tiny.gaussians(5)
    return VanillaModel.from_gaussians(replace(splats, sh=torch.full((5, 1, 3), -9.0)))


@pytest.mark.parametrize("recipe", ["default", "paper"])
def test_no_gradient_at_all_leaves_finite_splats(recipe):
    model = wrap_model(black_on_black(), cameras=tiny.cameras(1))
    adapted = model.adapt(1 / 4, recipe=recipe, views="given", steps=3, prune_every=2, merge_to=1.0)
    assert is_finite(adapted.model) and len(adapted.model) == 5


@pytest.mark.parametrize("settings", [dict(min_opacity=0.99, returns="last"), dict(min_opacity=0.99, recipe="paper", densify_gradient=1e-9)])
def test_everything_pruned_leaves_one_splat(settings):
    adapted = wrapped().adapt(1 / 4, **{"views": "given", "steps": 5, "prune_every": 1, **settings})
    assert is_finite(adapted.model) and adapted.report.gaussians_after == 1


@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize("views", ["given", "jittered"])
def test_one_view_and_the_same_view_twice(views, count):
    adapted = wrapped(cameras=tiny.cameras(1) * count).adapt(1 / 4, views=views, steps=3, extra_views=2, check_every=3)
    assert is_finite(adapted.model) and adapted.report.curve[-1].psnr_db > 20


@pytest.mark.parametrize(("scale", "size"), [(64, (4, 3)), (1 / 64, (32, 24)), (0.3, (31, 23)), (1e-9, (32, 24))])
@pytest.mark.parametrize("recipe", ["default", "paper"])
def test_extreme_and_crooked_scales(recipe, scale, size):
    views = tiny.cameras(1, width=size[0], height=size[1])
    adapted = wrapped(10, cameras=views).adapt(scale, recipe=recipe, views="given", steps=2)
    image = adapted.render(views[0].zoomed(scale)).image
    assert image.shape == (*views[0].zoomed(scale).size, 3)
    assert is_finite(adapted.model) and image.isfinite().all()


@pytest.mark.parametrize("degree", [0, 3])
def test_every_sh_degree_adapts(degree):
    model = wrap_model(tiny.model(10, degree=degree), cameras=tiny.cameras())
    adapted = model.adapt(1 / 4, steps=2, extra_views=0)
    assert adapted.model.sh_degree == degree and is_finite(adapted.model)


def test_double_precision_adapts_in_double_precision():
    splats = tiny.gaussians(10).to(dtype=torch.float64)
    adapted = wrap_model(VanillaModel.from_gaussians(splats), cameras=tiny.cameras()).adapt(1 / 4, steps=2, extra_views=0)
    assert adapted.model.parameters()["means"].dtype == torch.float64


def test_an_adapted_model_can_be_adapted_again():
    first = wrapped().adapt(1 / 2, steps=1, extra_views=0)
    half = [camera.zoomed(1 / 2) for camera in tiny.cameras()]
    again = wrap_model(first.model, cameras=half).adapt(1 / 2, steps=1, extra_views=0)
    assert is_finite(again.model) and again.model is not first.model


def test_a_phase_on_a_gpu_ends_when_the_gpu_is_done(monkeypatch):
    """What it is still at would count as the next one's."""
    waited = []
    monkeypatch.setattr(torch.cuda, "synchronize", waited.append)
    session = SimpleNamespace(scale=0.5, device=torch.device("cuda"), seconds={"merging": 1.0})
    with Session.phase(session, "merging"):
        pass
    assert session.seconds["merging"] > 1 and waited == [session.device] * 2


def test_memory_is_counted_on_a_gpu_and_from_its_beginning(monkeypatch):
    device, most = torch.device("cuda"), {"bytes": 5 << 30}
    monkeypatch.setattr(torch.cuda, "reset_peak_memory_stats", lambda which: most.update(bytes=0 if which == device else None))
    monkeypatch.setattr(torch.cuda, "max_memory_allocated", lambda which: most["bytes"])
    peak = PeakMemory(device)
    most["bytes"] += 3 << 20
    assert peak.mib() == 3
    assert PeakMemory(torch.device("cpu")).mib() is None
    assert wrapped().adapt(1 / 4, recipe="instant").report.peak_memory_mib is None


@pytest.mark.parametrize("scale", [Fraction(1, 2), np.float32(0.5), torch.tensor(0.5), Decimal("0.5")])
def test_a_scale_is_a_number_of_any_type(scale):
    report = wrap_model(tiny.model(), cameras=tiny.cameras(2)).adapt(scale, steps=0).report
    assert type(report.scale) is float and report.scale == 0.5


# What is refused


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        (dict(recipe="best"), "there is no recipe 'best'; choose from default, instant, paper, thorough"),
        (dict(stepz=3), r"there is no setting stepz; did you mean steps\? mipmap_plugin.config has all of them"),
        (dict(recipe="defualt"), r"there is no recipe 'defualt'; choose from .*; did you mean default\?"),
        (dict(recipe=print), r"^recipes are given by their names, got builtin_function_or_method; register your own first, by register_recipe"),
        (dict(viewer=["spark", "three"]), "^viewers are given by their names, got list; register your own first, by register_viewer"),
        (dict(upsampler=print), "^setting upsampler: must be the name of an upsampler, which register_upsampler gives to a function, got "),
        (dict(upsampler=Path("nowhere.pth")), "^there is no upsampler file nowhere.pth"),
        (dict(views=[tiny.cameras(1)[0]] * 3), "^setting views: must be 'given', .* or 'jittered', got a list$"),
        (dict(backend="cpu"), "^backend is no setting of an adaptation; give it to wrap_model$"),
        (dict(resume=""), "^resume must be a text .*, got an empty text$"),
        (dict(scale=[1 / 2, 1 / 4]), r"got \[0.5, 0.25\]; give one at a time$"),
        (dict(resume=5), r"resume must be a text such as 'output/bicycle', or a pathlib.Path, got int"),
        (dict(observe=5), "observe must be a Callable, got int"),
        (dict(views="some"), "^setting views: must be 'given', 'train', 'test', 'orbit' or 'jittered', got 'some'$"),
        (dict(views="test"), "there are no test views among the 4 cameras; give cameras that have some, or use the view policy 'given'"),
        (dict(resize="box", scale=0.3, steps=1), "is not a whole multiple of"),
    ],
)
def test_settings_that_cannot_be_served_are_refused_in_a_sentence(settings, sentence):
    with pytest.raises(SettingsError, match=sentence):
        wrapped().adapt(**{"scale": 4, **settings})


def test_an_unknown_backend_and_one_that_cannot(monkeypatch):
    monkeypatch.setattr(ReferenceBackend, "lacking", lambda self, needs: ["it has no gradients"] if needs.gradients else [])
    assert wrapped(backend="reference").adapt(4, recipe="instant").report.ended_by == "0 steps"  # which needs none
    assert wrapped(backend="reference").adapt(1 / 4, steps=0, merge_to=1.0).report.ended_by == "0 steps"
    ways = 'cannot do without gradients: recipe="instant" alone needs none'
    with pytest.raises(BackendUnavailable, match=rf"backend 'reference' cannot do this(, but cpu can)?: it has no gradients; steps {ways}$"):
        wrapped(backend="reference").adapt(1 / 4)
    for settings in (dict(steps=0), dict(recipe="instant", merge_to=0.5), dict(recipe="instant", most_splats=10)):
        with pytest.raises(BackendUnavailable, match=rf"; merging {ways}, and neither does merge_to=1\.0 without most_splats"):
            wrapped(backend="reference").adapt(1 / 4, **settings)
    monkeypatch.setattr(ReferenceBackend, "lacking", lambda self, needs: ["it is switched off"])
    with pytest.raises(BackendUnavailable, match=r"cannot do this(, but cpu can)?: it is switched off$"):
        wrapped(backend="reference").adapt(1 / 4)


def test_what_was_adapted_to_another_scale_is_not_adapted_again(tmp_path):
    base = wrap_model(tiny.model(), cameras=tiny.cameras())
    files = [base.adapt(scale, steps=0, viewer="antialiased").save(tmp_path / f"{scale}.ply") for scale in (0.5, 1.0)]
    with pytest.raises(SettingsError, match=r"0\.5\.ply was adapted to x0\.5, at which alone it looks right; adapt the checkpoint that"):
        wrap_model(files[0], cameras=tiny.cameras()).adapt(0.5, steps=0)
    wrap_model(files[1], cameras=tiny.cameras()).adapt(0.5, steps=0)
