"""Third-party backends: which is chosen and why; a broken one is listed with its reasons and breaks nothing."""

from dataclasses import replace

import pytest
import torch
from their_backends import NEEDS, Crashing, Fast, Fussy

from mipmap_plugin.backends import BACKENDS, choose_backend, device_for, get_backend, register_backend, survey
from mipmap_plugin.backends.base import API_VERSION, Needs
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.errors import BackendUnavailable, PluginError, SettingsError
from mipmap_plugin.evaluation.backends import check, listing, listing_table

pytestmark = pytest.mark.usefixtures("only_the_reference")


class OnGpu(ReferenceBackend):
    name = "gpu"

    def lacking(self, needs):
        return [] if needs.device == "cuda" else ["it runs on cuda"]


class Ancient(ReferenceBackend):
    api_version = API_VERSION - 1


def test_auto_takes_the_fastest_that_lacks_nothing_and_says_why():
    register_backend("fast", Fast)
    register_backend("fussy", Fussy)
    backend, why = choose_backend("auto", NEEDS)
    assert backend.name == "fast"
    assert why == "fast: the fastest that can serve the request; fussy cannot: it is not in the mood"


def test_on_a_gpu_the_fastest_comes_first(monkeypatch):
    built_in = {"gsplat": "GsplatBackend", "inria": "InriaBackend", "triton": "TritonBackend"}
    for name, kind in built_in.items():
        monkeypatch.setattr(f"mipmap_plugin.backends.{name}.{kind}.lacking", lambda self, needs: [])
        register_backend(name, f"mipmap_plugin.backends.{name}:{kind}")
    on_gpu, taken = replace(NEEDS, device="cuda"), []
    while (backend := choose_backend("auto", on_gpu)[0]).name != "reference":
        taken.append(backend.name)
        monkeypatch.setattr(type(backend), "lacking", lambda self, needs: ["it is not built"])
    assert taken == ["triton", "gsplat", "inria"]


def test_checkpoints_go_to_a_gpu_that_something_faster_serves(monkeypatch):
    register_backend("gpu", OnGpu)
    assert device_for("auto") == "cpu"
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert (device_for("auto"), device_for("gpu"), device_for("reference")) == ("cuda", "cuda", "cpu")
    monkeypatch.setattr(OnGpu, "lacking", lambda self, needs: ["it is not built"])
    assert (device_for("auto"), device_for("gpu")) == ("cpu", "cpu")


def test_asking_by_name():
    register_backend("fussy", Fussy)
    backend, why = choose_backend("reference", NEEDS)
    assert (type(backend), why) == (ReferenceBackend, "reference: requested")
    with pytest.raises(BackendUnavailable, match="backend 'fussy' cannot do this, but reference can: it is not in the mood; nor will it be"):
        choose_backend("fussy", NEEDS)
    with pytest.raises(SettingsError, match=r"^there is no backend 'gpu'; choose from fussy, reference$"):
        choose_backend("gpu", NEEDS)


def test_no_backend_at_all_gives_every_reason():
    register_backend("fussy", Fussy)
    needs = Needs("cpu", torch.float16, gradients=True, sh_degree=9, screen_filter="soft")
    with pytest.raises(BackendUnavailable) as caught:
        choose_backend("auto", needs)
    for reason in ("fussy: it is not in the mood", "not in torch.float16", "SH up to degree 4, not 9", "not soft"):
        assert reason in str(caught.value)


@pytest.mark.parametrize(
    ("target", "reason"),
    [
        ("no_such_package:Backend", "'bad' (no_such_package:Backend) cannot be loaded: ModuleNotFoundError: No module named 'no_such_package'"),
        ("mipmap_plugin.backends.reference:Missing", "cannot be loaded: AttributeError"),
        ("mipmap_plugin.backends.reference", "'bad' (mipmap_plugin.backends.reference) cannot be loaded; a target is written package.module:Name"),
        (ReferenceBackend(), "backend 'bad' is of type ReferenceBackend; register its class, or a function that makes one"),
        (Crashing, "backend 'bad' cannot be created: RuntimeError: no driver"),
        (Ancient, f"backend 'bad' is written for API version {API_VERSION - 1}, but this package has API version {API_VERSION}"),
        (object, f"backend 'bad' is written for API version unknown, but this package has API version {API_VERSION}"),
    ],
)
def test_a_broken_plugin_is_listed_with_its_reason_and_breaks_nothing(target, reason):
    register_backend("bad", target)
    reasons = survey(NEEDS)
    assert reasons["reference"] == [] and reason in reasons["bad"][0]
    assert choose_backend("auto", NEEDS)[0].name == "reference"
    with pytest.raises(PluginError) as caught:
        get_backend("bad")
    assert reason in str(caught.value)


def test_the_listing_names_every_backend_its_reasons_and_its_note():
    register_backend("fussy", type("Noted", (Fussy,), {"note": "slow today"}))
    here = {row.name: (row.reasons, row.note) for row in listing() if row.device == "cpu"}
    assert here == {"reference": ((), ""), "fussy": (("it is not in the mood", "nor will it be"), "slow today")}
    table = listing_table(listing())
    assert "no: it is not in the mood; nor will it be" in table and "yes" in table and "slow today" in table


def test_a_backend_that_serves_no_device_here_cannot_be_checked(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    register_backend("gsplat", "mipmap_plugin.backends.gsplat:GsplatBackend")
    with pytest.raises(BackendUnavailable, match="backend 'gsplat' cannot be checked here: it needs"):
        check("gsplat")


class Speechless:
    """A backend that fails when it is asked what it lacks."""

    name, api_version, speed = "speechless", API_VERSION, 99

    def lacking(self, needs):
        raise KeyError("device")

    def render(self, gaussians, camera, effects):
        raise AssertionError("it is never chosen")


class Slow:
    """A backend that does not say how fast it is."""

    name, api_version = "slow", API_VERSION
    lacking, render = Speechless.lacking, Speechless.render


def test_a_backend_that_breaks_its_contract_breaks_no_other():
    needs = Needs("cpu", torch.float32, gradients=False, sh_degree=0, screen_filter="classic")
    BACKENDS.add("speechless", Speechless)
    BACKENDS.add("slow", Slow)
    backend, why = choose_backend("auto", needs)
    assert backend.name in ("cpu", "reference")
    assert "'speechless' cannot say what it lacks: KeyError: 'device'" in why and "'slow' lacks speed" in why
    with pytest.raises(PluginError, match="'slow' lacks speed"):
        choose_backend("slow", needs)
