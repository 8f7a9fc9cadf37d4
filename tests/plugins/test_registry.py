"""Registries: what packages and callers add by name, imported at its first use."""

import os
import sys
from importlib.metadata import EntryPoint, entry_points

import pytest
import torch
from their_backends import NEEDS, Fast, Fussy

from mipmap_plugin import registry
from mipmap_plugin.backends import BACKENDS, choose_backend, get_backend, register_backend
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.commands.list import _facts as facts_of
from mipmap_plugin.errors import PluginError, SettingsError
from mipmap_plugin.registry import Registry, load_target
from mipmap_plugin.splatting.viewers import Viewer, single_viewers, viewers_for

pytestmark = pytest.mark.usefixtures("only_the_reference")

KIOSK = Viewer("kiosk", "Kiosk", "ours", "classic", 0.3)


@pytest.fixture
def install(monkeypatch):
    """Make it look as if packages with these entry points were installed."""

    def do(name, *values, group="mipmap_plugin.backends"):
        points = [EntryPoint(name, value, group) for value in values]
        monkeypatch.setattr(registry, "entry_points", lambda group: [point for point in points if point.group == group])

    return do


@pytest.fixture
def module(tmp_path, monkeypatch):
    """Write `their_module`, which can be imported while the test lasts."""
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "their_module", raising=False)
    yield (tmp_path / "their_module.py").write_text
    sys.modules.pop("their_module", None)


def test_a_name_is_taken_once():
    register_backend("fast", Fast)
    register_backend("fast", Fast)  # the same again is no conflict
    with pytest.raises(SettingsError, match="the name 'fast' is taken; pass replace=True to override it"):
        register_backend("fast", Fussy)
    register_backend("fast", Fussy, replace=True)
    assert get_backend("fast").name == "fussy"


def test_an_installed_backend_is_seen_and_used(install):
    install("ours", "their_backends:Fast")
    assert BACKENDS.names() == ["ours", "reference"]
    assert choose_backend("auto", NEEDS)[0].name == "fast"


def test_an_installed_package_cannot_shadow_a_built_in(install):
    install("reference", "their_backends:Fussy")
    assert type(get_backend("reference")) is ReferenceBackend


def test_a_viewer_of_a_package_has_a_name_that_files_can_have_too(install):
    install("our/kiosk", f"{__name__}:KIOSK", group="mipmap_plugin.viewers")
    told = "viewers are named in files: a name begins with a letter or a digit"
    assert f"not used: {told}" in facts_of("viewers")["of packages"]["our/kiosk"] and "our/kiosk" not in single_viewers()
    with pytest.raises(PluginError, match=told):
        viewers_for("our/kiosk")


def test_of_two_packages_with_one_name_the_first_is_used_and_the_other_is_told(install):
    install("ours", "their_backends:Fast", "their_backends:Fussy")
    assert get_backend("ours").name == "fast"
    assert BACKENDS.packages() == {"ours": ["their_backends:Fast", "their_backends:Fussy"]}


def test_a_package_without_metadata_is_named_by_its_folder(tmp_path, monkeypatch):
    """As a broken installation leaves one."""
    folder = tmp_path / "stranger-1.0.dist-info"
    folder.mkdir()
    (folder / "entry_points.txt").write_text("[mipmap_plugin.backends]\nmine = stranger:Backend\n")
    monkeypatch.syspath_prepend(tmp_path)
    assert BACKENDS.packages()["mine"] == [f"stranger:Backend of {folder}"]
    (folder / "entry_points.txt").write_text("[any]\nmine\n")
    assert f"the installed package {folder} cannot be read" in registry.unreadable_package()


def test_what_is_wrong_with_the_first_of_two_packages_with_one_name_is_told_of_it(install):
    install("ours", "their_backends:Crashing", "their_backends:Fussy")
    broken = "their_backends:Crashing, not used: backend 'ours' cannot be created: RuntimeError: no driver"
    assert facts_of("backends")["of packages"] == {"ours": f"{broken}; not used, as the name is the same: their_backends:Fussy"}


def test_a_plug_in_that_is_imported_leaves_torch_as_it_was(module):
    def state():
        return torch.get_default_dtype(), torch.zeros(()).device, torch.is_grad_enabled(), torch.get_num_threads(), torch.get_rng_state().tolist()

    sets = "set_default_dtype(torch.float64)", "set_default_device('meta')", "set_grad_enabled(False)", "set_num_threads(3)", "manual_seed(7)"
    module("\n".join(["import torch", *(f"torch.{line}" for line in sets), "thing = torch.get_default_dtype()"]))
    before = state()
    assert load_target("theirs", "their_module:thing") == torch.float64
    assert state() == before


# Of torch 2.9 and newer.
NEWER = ["torch.backends.cuda.matmul.fp32_precision = torch.backends.fp32_precision = 'tf32'"] * hasattr(torch.backends, "fp32_precision")


@pytest.mark.parametrize("line", ["torch.set_float32_matmul_precision('high')", "torch.backends.cuda.matmul.allow_tf32 = True", *NEWER])
def test_the_precision_that_a_plug_in_sets_is_undone_by_all_ways_to_tell_it(module, line):
    """Torch refused to tell it any more, as of two interfaces that were mixed."""

    def state():
        return torch.get_float32_matmul_precision(), torch.backends.cuda.matmul.allow_tf32

    module(f"import torch\n{line}\nthing = 1")
    before = state()
    load_target("theirs", "their_module:thing")
    assert state() == before


@pytest.mark.parametrize("target", ["mipmap_plugin.registry:Registry.names", "mipmap_plugin.registry:Registry.names [fast]"])
def test_targets_are_written_as_those_of_entry_points(target):
    assert load_target("names", target) is Registry.names


def test_targets_are_imported_only_when_used(module):
    module("thing = 'made'")
    things = Registry("group", {"lazy": "their_module:thing"})
    assert things.names() == ["lazy"] and "their_module" not in sys.modules
    assert things.get("lazy") == "made"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("raise ValueError('half')", "ValueError: half"),
        ("import sys; sys.exit(3)", "SystemExit: 3"),
        ("raise RuntimeError('no driver\\n  of any kind')", "RuntimeError: no driver of any kind$"),
    ],
)
def test_a_module_that_fails_while_it_is_imported_is_a_broken_target(module, text, said):
    module(text)
    with pytest.raises(PluginError, match=f"cannot be loaded: {said}"):
        load_target("theirs", "their_module:thing")


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


@pytest.mark.parametrize("name", [3, None, ["spark"]])
def test_a_name_is_a_text(name):
    with pytest.raises(SettingsError, match="a name is a text"):
        BACKENDS.add(name, Fast)
    with pytest.raises(SettingsError, match=r"^backends are given by their names, got \w+; register your own first, by register_backend\(name"):
        BACKENDS.get(name)


@pytest.mark.parametrize("name", ["Spark", "sparkk"])
def test_a_name_like_a_known_one_is_asked_for(name):
    with pytest.raises(SettingsError, match=r"choose from other, spark; did you mean spark\?$"):
        Registry("mipmap_plugin.viewers", {"spark": 1, "other": 2}).get(name)
