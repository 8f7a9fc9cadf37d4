"""Registries: third-party backends are listed with their reasons, and a broken one breaks nothing."""

import os
import sys
from dataclasses import replace
from importlib.metadata import EntryPoint, entry_points

import pytest
import torch

from mipmap_plugin import registry
from mipmap_plugin.backends import BACKENDS, choose_backend, device_for, get_backend, register_backend, survey
from mipmap_plugin.backends.base import API_VERSION, Needs
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.commands.list import _facts as facts_of
from mipmap_plugin.errors import BackendUnavailable, PluginError, SettingsError
from mipmap_plugin.evaluation.backends import check, listing, listing_table
from mipmap_plugin.registry import Registry, load_target
from mipmap_plugin.splatting.viewers import Viewer, single_viewers, viewers_for

NEEDS = Needs("cpu", torch.float32, gradients=True, sh_degree=1, screen_filter="classic")


KIOSK = Viewer("kiosk", "Kiosk", "ours", "classic", 0.3)


class Fast(ReferenceBackend):
    name = "fast"
    speed = 1000


class Fussy(ReferenceBackend):
    name = "fussy"
    speed = 2000

    def lacking(self, needs):
        return ["it is not in the mood", "nor will it be"]


class OnGpu(ReferenceBackend):
    name = "gpu"

    def lacking(self, needs):
        return [] if needs.device == "cuda" else ["it runs on cuda"]


class Ancient(ReferenceBackend):
    api_version = API_VERSION - 1


class Crashing:
    def __init__(self):
        raise RuntimeError("no driver")


@pytest.fixture(autouse=True)
def only_the_reference(monkeypatch):
    monkeypatch.setattr(BACKENDS, "_targets", {"reference": "mipmap_plugin.backends.reference:ReferenceBackend"})


@pytest.fixture
def install(monkeypatch):
    """Make it look as if a package with this entry point were installed."""

    def do(name, value, group="mipmap_plugin.backends"):
        points = [EntryPoint(name, value, group)]
        monkeypatch.setattr(registry, "entry_points", lambda group: [point for point in points if point.group == group])

    return do


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


def test_a_plugin_that_fails_while_it_is_imported(tmp_path, monkeypatch):
    (tmp_path / "failing_plugin.py").write_text("raise ValueError('half installed')")
    monkeypatch.syspath_prepend(tmp_path)
    register_backend("bad", "failing_plugin:Backend")
    assert "ValueError: half installed" in survey(NEEDS)["bad"][0]


def test_the_listing_names_every_backend_and_its_reasons():
    register_backend("fussy", Fussy)
    here = {row.name: row.reasons for row in listing() if row.device == "cpu"}
    assert here == {"reference": (), "fussy": ("it is not in the mood", "nor will it be")}
    table = listing_table(listing())
    assert "no: it is not in the mood; nor will it be" in table and "yes" in table


def test_the_listing_has_the_notes_of_backends():
    register_backend("fussy", type("Noted", (Fussy,), {"note": "slow today"}))
    assert {row.name: row.note for row in listing()} == {"reference": "", "fussy": "slow today"}
    assert "slow today" in listing_table(listing())


def test_a_backend_that_serves_no_device_here_cannot_be_checked(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    register_backend("gsplat", "mipmap_plugin.backends.gsplat:GsplatBackend")
    with pytest.raises(BackendUnavailable, match="backend 'gsplat' cannot be checked here: it needs"):
        check("gsplat")


def test_a_name_is_taken_once():
    register_backend("fast", Fast)
    register_backend("fast", Fast)  # the same again is no conflict
    with pytest.raises(SettingsError, match="the name 'fast' is taken; pass replace=True to override it"):
        register_backend("fast", Fussy)
    register_backend("fast", Fussy, replace=True)
    assert get_backend("fast").name == "fussy"


def test_an_installed_backend_is_seen_and_used(install):
    install("ours", f"{__name__}:Fast")
    assert BACKENDS.names() == ["ours", "reference"]
    assert choose_backend("auto", NEEDS)[0].name == "fast"


def test_an_installed_package_cannot_shadow_a_built_in(install):
    install("reference", f"{__name__}:Fussy")
    assert type(get_backend("reference")) is ReferenceBackend


def test_a_viewer_of_a_package_has_a_name_that_files_can_have_too(install):
    install("our/kiosk", f"{__name__}:KIOSK", "mipmap_plugin.viewers")
    told = "viewers are named in files: a name begins with a letter or a digit"
    assert f"not used: {told}" in facts_of("viewers")["of packages"]["our/kiosk"] and "our/kiosk" not in single_viewers()
    with pytest.raises(PluginError, match=told):
        viewers_for("our/kiosk")


def test_of_two_packages_with_one_name_the_first_is_used_and_the_other_is_told(monkeypatch):
    points = [EntryPoint("ours", f"{__name__}:{kind}", "mipmap_plugin.backends") for kind in ("Fast", "Fussy")]
    monkeypatch.setattr(registry, "entry_points", lambda group: points)
    assert get_backend("ours").name == "fast"
    assert BACKENDS.packages() == {"ours": [f"{__name__}:Fast", f"{__name__}:Fussy"]}


def test_a_package_without_metadata_is_named_by_its_folder(tmp_path, monkeypatch):
    """As a broken installation leaves one."""
    folder = tmp_path / "stranger-1.0.dist-info"
    folder.mkdir()
    (folder / "entry_points.txt").write_text("[mipmap_plugin.backends]\nmine = stranger:Backend\n")
    monkeypatch.syspath_prepend(tmp_path)
    assert BACKENDS.packages()["mine"] == [f"stranger:Backend of {folder}"]
    (folder / "entry_points.txt").write_text("[any]\nmine\n")
    assert f"the installed package {folder} cannot be read" in registry.unreadable_package()


def test_what_is_wrong_with_the_first_of_two_packages_with_one_name_is_told_of_it(monkeypatch):
    points = [EntryPoint("ours", f"{__name__}:{kind}", "mipmap_plugin.backends") for kind in ("Crashing", "Fussy")]
    monkeypatch.setattr(registry, "entry_points", lambda group: points)
    broken = f"{__name__}:Crashing, not used: backend 'ours' cannot be created: RuntimeError: no driver"
    assert facts_of("backends")["of packages"] == {"ours": f"{broken}; not used, as the name is the same: {__name__}:Fussy"}


def test_a_plug_in_that_is_imported_leaves_torch_as_it_was(tmp_path, monkeypatch):
    def state():
        return torch.get_default_dtype(), torch.zeros(()).device, torch.is_grad_enabled(), torch.get_num_threads(), torch.get_rng_state().tolist()

    sets = "set_default_dtype(torch.float64)", "set_default_device('meta')", "set_grad_enabled(False)", "set_num_threads(3)", "manual_seed(7)"
    (tmp_path / "bossy_plugin.py").write_text("\n".join(["import torch", *(f"torch.{line}" for line in sets), "thing = torch.get_default_dtype()"]))
    monkeypatch.syspath_prepend(tmp_path)
    before = state()
    assert load_target("bossy", "bossy_plugin:thing") == torch.float64
    assert state() == before


# Of torch 2.9 and newer.
NEWER = ["torch.backends.cuda.matmul.fp32_precision = torch.backends.fp32_precision = 'tf32'"] * hasattr(torch.backends, "fp32_precision")


@pytest.mark.parametrize("line", ["torch.set_float32_matmul_precision('high')", "torch.backends.cuda.matmul.allow_tf32 = True", *NEWER])
def test_the_precision_that_a_plug_in_sets_is_undone_by_all_ways_to_tell_it(tmp_path, monkeypatch, line):
    """Torch refused to tell it any more, as of two interfaces that were mixed."""

    def state():
        return torch.get_float32_matmul_precision(), torch.backends.cuda.matmul.allow_tf32

    (tmp_path / "rough_plugin.py").write_text(f"import torch\n{line}\nthing = 1")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "rough_plugin", raising=False)
    before = state()
    load_target("rough", "rough_plugin:thing")
    assert state() == before


@pytest.mark.parametrize("target", ["mipmap_plugin.registry:Registry.names", "mipmap_plugin.registry:Registry.names [fast]"])
def test_targets_are_written_as_those_of_entry_points(target):
    assert load_target("names", target) is Registry.names


def test_targets_are_imported_only_when_used(tmp_path, monkeypatch):
    (tmp_path / "lazy_plugin.py").write_text("thing = 'made'")
    monkeypatch.syspath_prepend(tmp_path)
    things = Registry("group", {"lazy": "lazy_plugin:thing"})
    assert things.names() == ["lazy"] and "lazy_plugin" not in sys.modules
    assert things.get("lazy") == "made"
    sys.modules.pop("lazy_plugin")


def test_installed_packages_are_read_again_only_when_a_folder_of_them_changes(monkeypatch, tmp_path):
    asked = []
    monkeypatch.setattr(registry, "entry_points", lambda group: (asked.append(group), entry_points(group=group))[1])
    monkeypatch.syspath_prepend(tmp_path)
    plug_ins = Registry("mipmap_plugin.nothing", {})
    assert (plug_ins.names(), plug_ins.names(), len(asked)) == ([], [], 1)
    (tmp_path / "stranger-1.0.dist-info").mkdir()
    (tmp_path / "stranger-1.0.dist-info" / "METADATA").write_text("Metadata-Version: 2.1\nName: stranger\nVersion: 1.0\n")
    (tmp_path / "stranger-1.0.dist-info" / "entry_points.txt").write_text("[mipmap_plugin.nothing]\nstrange = stranger:Strange\n")
    os.utime(tmp_path, (1, 1))
    assert (plug_ins.names(), plug_ins.names(), len(asked)) == (["strange"], ["strange"], 2)


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
    with BACKENDS.temporarily(speechless=Speechless, slow=Slow):
        backend, why = choose_backend("auto", needs)
        assert backend.name in ("cpu", "reference")
        assert "'speechless' cannot say what it lacks: KeyError: 'device'" in why and "'slow' lacks speed" in why
        with pytest.raises(PluginError, match="'slow' lacks speed"):
            choose_backend("slow", needs)


def test_a_module_that_ends_the_process_is_a_broken_target(tmp_path, monkeypatch):
    (tmp_path / "leaves.py").write_text("import sys\nsys.exit(3)\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(PluginError, match="cannot be loaded: SystemExit: 3"):
        load_target("leaves", "leaves:Backend")


@pytest.mark.parametrize("name", [3, None, ["spark"]])
def test_a_name_is_a_text(name):
    with pytest.raises(SettingsError, match="a name is a text"):
        BACKENDS.add(name, Slow)
    with pytest.raises(SettingsError, match=r"^backends are given by their names, got \w+; register your own first, by register_backend\(name"):
        BACKENDS.get(name)


@pytest.mark.parametrize("name", ["Spark", "sparkk"])
def test_a_name_like_a_known_one_is_asked_for(name):
    with pytest.raises(SettingsError, match=r"choose from other, spark; did you mean spark\?$"):
        Registry("mipmap_plugin.viewers", {"spark": 1, "other": 2}).get(name)
