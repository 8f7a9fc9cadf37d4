"""The arguments that gsplat is called with, and what its torch implementations render with them on the CPU."""

import importlib.util
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from gsplat_stand_in import StandIn
from samples import camera, gaussians

from mipmap_plugin.backends import BACKENDS, survey
from mipmap_plugin.backends import gsplat as module
from mipmap_plugin.backends.base import Needs
from mipmap_plugin.backends.conformance import CASES, check_backend
from mipmap_plugin.backends.external import NO_CUDA
from mipmap_plugin.backends.gsplat import NO_GSPLAT, NOT_COMPILED, GsplatBackend, arguments
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.effects import Effects
from mipmap_plugin.errors import BackendUnavailable
from mipmap_plugin.render_settings import RenderSettings
from mipmap_plugin.splatting.projection import covariances_of
from mipmap_plugin.splatting.rotations import unit_quaternions

gsplat = pytest.importorskip("gsplat", reason="gsplat is in the test extra")

USUAL = Needs("cuda", torch.float32, gradients=True, sh_degree=3, screen_filter="classic")
WIDE = camera(50, 40, 30.0, 26.0, cx=21.3, cy=18.9)

# Where gsplat 1.5 differs from the reference by more than rounding, and why.
FEWER_DIGITS = {f"needle-1e12-{kind}" for kind in ("classic", "antialiased", "mip")}
LARGER_ALPHA = {f"opacity-{how}-{kind}" for how in ("1", "1-1e-7", "logit-80") for kind in ("classic", "antialiased", "mip")}
NO_LEAST_COMPENSATION = {f"scale-{size}-antialiased" for size in ("0-on-two-axes", "0-on-three-axes", "1e-20", "1e-20-on-two-axes")} | {
    "antialiased-1", "antialiased-2", "gsplat-antialiased-1", "gsplat-antialiased-2",
}  # fmt: skip
TWINS_ROOT_AT_ZERO = {"scale-0-on-three-axes-antialiased", "scale-0-on-three-axes-mip", "scale-1e-20-mip"}  # its kernel divides by a little more
ONLY_BEFORE_TORCH_2_14 = TWINS_ROOT_AT_ZERO | {"scale-1e-20-antialiased"}  # whose gradient of a clamped 0 under a root is NaN
KNOWN = FEWER_DIGITS | LARGER_ALPHA | NO_LEAST_COMPENSATION | TWINS_ROOT_AT_ZERO


class OnProcessor(GsplatBackend):
    capabilities = replace(GsplatBackend.capabilities, devices=frozenset({"cpu"}))

    def lacking(self, needs):
        return self.capabilities.lacking(needs)


@pytest.fixture
def stand_in(monkeypatch):
    twin = StandIn()
    monkeypatch.setattr(gsplat, "rasterization", twin)
    monkeypatch.setattr(module, "unloadable", lambda: "")
    return twin


def test_the_arguments_are_those_of_gsplat(stand_in):
    splats = gaussians(20, 2, dtype=torch.float32)
    effects = Effects(1, "classic", 0.3 * 4**2, (0.2, 0.5, 0.9), near_plane=0.25)  # the `scaled` filter at x4
    OnProcessor().render(splats, WIDE, effects)
    args, named = stand_in.received, arguments(splats, WIDE, effects)
    assert set(named) <= set(stand_in.signature.parameters)
    assert (args["width"], args["height"], args["sh_degree"], args["eps2d"], args["rasterize_mode"]) == (50, 40, 1, 4.8, "classic")
    assert args["Ks"][0].tolist() == [[30.0, 0.0, pytest.approx(21.3)], [0.0, 26.0, pytest.approx(18.9)], [0.0, 0.0, 1.0]]
    assert args["backgrounds"].tolist() == [[pytest.approx(0.2), 0.5, pytest.approx(0.9)]]
    assert (args["packed"], args["covars"], args["render_mode"]) == (False, None, "RGB")
    assert 0.25 < args["near_plane"] < 0.25 + 1e-7
    assert torch.equal(args["colors"], splats.sh) and torch.equal(args["quats"], unit_quaternions(splats.quats))


def test_the_eye_becomes_the_origin(stand_in):
    splats = gaussians(20, dtype=torch.float32)
    OnProcessor().render(splats, WIDE, Effects(1))
    viewmat, means = stand_in.received["viewmats"][0], stand_in.received["means"]
    assert viewmat[:3, 3].tolist() == [0.0, 0.0, 0.0]
    there = splats.means.double() @ WIDE.viewmat[:3, :3].T + WIDE.viewmat[:3, 3]
    torch.testing.assert_close(means @ viewmat[:3, :3].T, there.float())


@pytest.mark.parametrize("screen_filter", ["antialiased", "mip"])
def test_filters_that_compensate_are_gsplats_antialiased(stand_in, screen_filter):
    OnProcessor().render(gaussians(20, dtype=torch.float32), WIDE, Effects(1, screen_filter, 0.1))
    assert (stand_in.received["rasterize_mode"], stand_in.received["eps2d"]) == ("antialiased", 0.1)


def test_covariances_are_passed_on(stand_in):
    splats = gaussians(20, dtype=torch.float32)
    splats = replace(splats, covariances=covariances_of(splats))
    OnProcessor().render(splats, WIDE, Effects(1))
    assert torch.equal(stand_in.received["covars"], splats.covariances)


def test_gsplats_twins_draw_the_reference_but_for_what_is_known(stand_in):
    cases = {name: build for name, build in CASES.items() if not name.startswith("10000")}  # too slow in the Python loops of the stand-in
    outcomes = check_backend(OnProcessor(), cases)
    assert {outcome.case for outcome in outcomes if not outcome.passed} in (KNOWN, KNOWN - ONLY_BEFORE_TORCH_2_14)
    drawn = [outcome for outcome in outcomes if not outcome.skipped]
    integrated = {case for case in cases if "analytic" in case or "window" in case}
    of_a_viewer = {case for case, build in cases.items() if build().effects.settings != RenderSettings()}
    assert set(cases) - integrated - of_a_viewer == {outcome.case for outcome in drawn}
    assert max(outcome.max_error for outcome in drawn if outcome.case in LARGER_ALPHA) < 0.009


def test_with_the_cap_of_later_versions_opaque_splats_are_the_references(stand_in):
    stand_in.max_alpha = 0.99
    assert all(outcome.passed for outcome in check_backend(OnProcessor(), {case: CASES[case] for case in sorted(LARGER_ALPHA)}))


def test_nothing_is_cut_that_the_reference_draws(stand_in):
    splats = gaussians(1, dtype=torch.float32)
    splats = replace(splats, opacities=torch.ones(1), scales=torch.full((1, 3), 0.4))
    rendered = OnProcessor().render(splats, WIDE, Effects(1))
    assert torch.equal(rendered.alpha > 0, ReferenceBackend().render(splats, WIDE, Effects(1)).alpha > 0)


def test_what_is_missing_is_reported(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert GsplatBackend().lacking(USUAL) == [NO_CUDA]
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(module, "_nvcc", lambda: False)
    assert GsplatBackend().lacking(USUAL) == [NOT_COMPILED]
    monkeypatch.setattr(module, "_nvcc", lambda: True)
    assert GsplatBackend().lacking(USUAL) == []
    assert "not window" in GsplatBackend().lacking(replace(USUAL, screen_filter="window"))[0]
    assert "not in torch.float64" in GsplatBackend().lacking(replace(USUAL, dtype=torch.float64))[0]
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert GsplatBackend().lacking(USUAL) == [NO_GSPLAT]


@pytest.mark.parametrize(("loaded", "said"), [(RuntimeError("Error building extension 'gsplat_cuda'\n..."), "Error building"), (None, NOT_COMPILED)])
def test_a_cuda_part_that_does_not_load_is_said_in_a_sentence(loaded, said, monkeypatch):
    def load(name):
        if isinstance(loaded, Exception):
            raise loaded
        return SimpleNamespace(_C=loaded)

    monkeypatch.setattr(module.importlib, "import_module", load)
    module.unloadable.cache_clear()
    with pytest.raises(BackendUnavailable, match="backend 'gsplat' cannot do this: ") as caught:
        OnProcessor().render(gaussians(2, dtype=torch.float32), WIDE, Effects(1))
    module.unloadable.cache_clear()
    assert said in str(caught.value)


def test_a_gsplat_that_cannot_be_imported_is_said_in_a_sentence(monkeypatch):
    """Looking for its CUDA part imports it."""

    def find(name):
        raise ImportError("numpy.core.multiarray failed to import")

    monkeypatch.setattr(module.importlib.util, "find_spec", find)
    module.unloadable.cache_clear()
    said = module.unloadable()
    module.unloadable.cache_clear()
    assert said.startswith("gsplat's CUDA part does not compile or load here (numpy.core")


def test_it_is_listed_with_its_reasons_and_refuses(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert "gsplat" in BACKENDS.names()
    assert survey(replace(USUAL, device="cpu"))["gsplat"] == [NO_CUDA, "it runs on cuda, not on cpu"]
    with pytest.raises(BackendUnavailable, match="backend 'gsplat' cannot do this: it needs a CUDA GPU"):
        GsplatBackend().render(gaussians(2, dtype=torch.float32), WIDE, Effects(1))


def test_requirements_are_checked_once_per_kind_of_request(stand_in, monkeypatch):
    backend, checked = OnProcessor(), []
    monkeypatch.setattr(OnProcessor, "lacking", lambda self, needs: checked.append(needs) or [])
    for filters in ("classic", "classic", "mip"):
        backend.render(gaussians(2, dtype=torch.float32), WIDE, Effects(1, filters))
    assert [needs.screen_filter for needs in checked] == ["classic", "mip"]


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU")
def test_gsplat_itself_draws_the_reference_but_for_what_is_known():
    wrong = {outcome.case: outcome.message for outcome in check_backend(GsplatBackend(), device="cuda") if not outcome.passed}
    assert set(wrong) <= KNOWN, wrong
