"""SH bands that a zoom-out adds where merging has made room for them."""

import time

import pytest
import tiny
import torch

from mipmap_plugin import wrap_model
from mipmap_plugin.adaptation import session
from mipmap_plugin.adaptation.optimization.resume import Interrupted
from mipmap_plugin.adaptation.start.bands import used_degree, with_more_bands
from mipmap_plugin.backends import register_backend
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.levels.request import LadderRequest
from mipmap_plugin.models import load_model
from mipmap_plugin.models.base import TrainedScale
from mipmap_plugin.models.surfels import SurfelModel
from mipmap_plugin.models.vanilla import VanillaModel

NUMBERS = {0: 14, 1: 23, 2: 38, 3: 59}  # of a splat, by degree
STEPS = dict(steps=12, merging_costs=30.0)  # so that merging is allowed whatever it costs


def crowd(degree=0, room=None):
    """Splats of which so many share a pixel at x1/8 that merging leaves a few; `room`: the degree that their arrays have."""
    splats = tiny.gaussians(200, degree=max(degree, room or 0), spread=0.3)
    splats.sh[:, (degree + 1) ** 2 :] = 0
    return wrap_model(VanillaModel.from_gaussians(splats, TrainedScale()), cameras=tiny.cameras(8, width=96, height=72))


@pytest.mark.parametrize("used", [0, 1, 2, 3])
@pytest.mark.parametrize("left", [20, 45, 60, 90, 160, 200])
def test_bands_are_those_that_leave_no_more_numbers_than_the_base_has(used, left):
    start = tiny.model(left, degree=used)
    fitting = [degree for degree in NUMBERS if degree >= used and left * NUMBERS[degree] <= 200 * NUMBERS[used]]
    padded, degree = with_more_bands(start, tiny.model(200, degree=used), used, 3, None)
    assert padded.sh_degree == degree == max(fitting)
    splats = padded.gaussians()
    assert torch.equal(splats.sh[:, : (used + 1) ** 2], start.gaussians().sh)
    assert not splats.sh[:, (used + 1) ** 2 :].any()


def test_no_bands_are_added_beyond_those_that_are_asked_for():
    padded, degree = with_more_bands(tiny.model(10, degree=0), tiny.model(200, degree=0), 0, 1, None)
    assert padded.sh_degree == degree == 1


@pytest.mark.parametrize(("viewer", "left", "degree"), [("unity", 100, 0), ("unity", 45, 3), ("3dgs.cpp", 100, 0), ("spark", 100, 1)])
def test_bands_that_a_loader_reads_only_as_others_count_as_those(viewer, left, degree):
    """Unity's reads a PLY of degree 1 or 2 as one of 3, and 3DGS.cpp's every PLY."""
    assert with_more_bands(tiny.model(left, degree=0), tiny.model(200, degree=0), 0, 3, viewer)[1] == degree


def test_bands_that_a_file_has_for_nothing_make_no_room():
    padded, degree = with_more_bands(tiny.model(200, degree=3), tiny.model(200, degree=3), 0, 3, None)
    assert (padded.sh_degree, degree) == (3, 0)


def test_merged_splats_learn_colors_that_depend_on_the_view(tmp_path):
    base = crowd()
    adapted = base.adapt(1 / 8, **STEPS)
    plain = base.adapt(1 / 8, **STEPS, most_sh_degree=0)
    assert adapted.report.gaussians_after < 200 * NUMBERS[0] / NUMBERS[2]
    assert adapted.model.gaussians().used_sh_degree() == 2 and plain.model.gaussians().used_sh_degree() == 0
    assert adapted.report.psnr_after() > plain.report.psnr_after()
    assert any("up to SH degree 2" in note for note in adapted.report.notes)
    color = next(effect for effect in adapted.report.effects if effect.name == "view-dependent color")
    assert color.on and color.reason == "SH up to degree 2, of the base up to 0: merging has made room for more"
    view = base.views()[0].zoomed(1 / 8)
    again = load_model(adapted.save(tmp_path / "small.ply"))
    assert torch.allclose(wrap_model(again).render(view).image, adapted.render(view).image, atol=1e-5)


def test_bands_that_a_file_has_for_nothing_are_used_where_merging_has_made_room():
    adapted = crowd(room=3).adapt(1 / 8, **STEPS)
    assert adapted.model.sh_degree == 3 and adapted.model.gaussians().used_sh_degree() == 2
    assert any("up to SH degree 2, those of the base up to 0" in note for note in adapted.report.notes)
    color = next(effect for effect in adapted.report.effects if effect.name == "view-dependent color")
    assert color.reason == "SH up to degree 2, of the base up to 0: merging has made room for more"


@pytest.mark.parametrize(
    "options", [dict(most_splats=40), dict(viewer="gaussian-splats-3d"), dict(viewer="portable"), dict(recipe="paper"), dict(steps=0)]
)
def test_no_bands_are_added_for(options):
    """A number of splats that stands for bytes, a viewer that draws none, alone or of several, the published method, and where nothing is learned."""
    assert crowd().adapt(1 / 8, **STEPS | options).model.sh_degree == 0


def test_compiling_what_draws_more_bands_is_time_of_adapting(monkeypatch):
    compiled = session.warm_up

    def slowly(backend, gaussians, *rest):
        time.sleep(0.5 if gaussians.sh_degree else 0)
        compiled(backend, gaussians, *rest)

    monkeypatch.setattr(session, "warm_up", slowly)
    seconds = crowd().adapt(1 / 8, **STEPS).report.seconds
    assert sum(seconds[name] for name in seconds if name not in ("total", "loading")) < seconds["total"] + 0.3


def interrupted(step, seconds, render):
    if step == 6:
        raise KeyboardInterrupt


def test_a_resumed_run_draws_the_bands_that_it_has_whatever_its_start_has_now(tmp_path, monkeypatch):
    """In a time budget, and on a GPU, merging may leave others the next time."""
    with pytest.raises(Interrupted):
        crowd().adapt(1 / 8, **STEPS, resume=tmp_path / "state", observe=interrupted)
    monkeypatch.setattr(session, "best_start", lambda problems: (problems[0].base(), "the base", []))
    adapted = crowd().adapt(1 / 8, **STEPS, resume=tmp_path / "state")
    assert adapted.model.gaussians().used_sh_degree() == adapted.effects.sh_degree == 2


def test_flat_splats_that_got_bands_are_drawn_with_them():
    assert used_degree(SurfelModel(tiny.model(5, degree=2).parameters(), TrainedScale())) == 2


class OfOneBand(ReferenceBackend):
    """Of a third party, that draws only what it says."""

    name = "one-band"

    def lacking(self, needs):
        return ["it has one band"] * (needs.sh_degree > 1)

    def render(self, gaussians, camera, effects):
        assert effects.sh_degree <= 1
        return super().render(gaussians, camera, effects)


def test_a_backend_is_asked_for_no_more_bands_than_it_draws():
    register_backend("one-band", OfOneBand)
    splats = crowd().model.gaussians().detach()
    base = wrap_model(VanillaModel.from_gaussians(splats, TrainedScale()), cameras=tiny.cameras(8, width=96, height=72), backend="one-band")
    assert base.adapt(1 / 8, **STEPS).model.gaussians().used_sh_degree() == 1


def test_levels_have_the_bands_of_their_base():
    assert LadderRequest("supersplat").arguments({})["most_sh_degree"] == 0


def test_what_begins_with_splats_that_got_bands_draws_them():
    base = crowd()
    finer = base.adapt(1 / 8, **STEPS)
    coarser = base.adapt(1 / 10, start=finer, steps=0)
    assert finer.model.gaussians().used_sh_degree() == coarser.model.gaussians().used_sh_degree() == coarser.effects.sh_degree == 2
