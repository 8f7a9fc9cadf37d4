"""`backends` and `list`: what is there, where it comes from, and what is wrong with it."""

import json

import pytest
import torch
from commands_run import refused

from mipmap_plugin import register_backend
from mipmap_plugin.backends.conformance import CASES, MORE, Outcome
from mipmap_plugin.commands.list import GROUPS, KINDS, registry_of
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.evaluation import backends as backends_module

pytestmark = pytest.mark.usefixtures("few_views")


def test_backends_lists_each_with_its_reasons(run, monkeypatch):
    code, out, _ = run("backends")
    assert code == 0 and "| reference " in out and "adapts 3DGS?" in out
    code, out, _ = run("backends", "--json")
    assert code == 0 and {"name": "reference", "device": "cpu", "reasons": [], "note": ""} in json.loads(out)


def test_backends_check_prints_a_table_and_fails_if_a_case_does(run, monkeypatch):
    outcomes = [Outcome("fine", 1e-6, True, True, ""), Outcome("odd", 0.5, True, False, "the image differs")]
    monkeypatch.setattr(backends_module, "CASES", {"one": None})
    monkeypatch.setattr(backends_module, "check_backend", lambda backend, cases, dtype, device: outcomes)
    code, out, err = run("backends", "--check", "reference")
    assert code == 2 and "FAIL: the image differs" in out and "| fine " in out
    assert err == "mipmap-plugin: backend 'reference' fails 1 of 2 cases: odd\n"
    assert out.rstrip().endswith("2 cases: 2 run, 0 skipped, 1 failed")
    outcomes.pop()
    assert run("backends", "--check", "reference")[0] == 0
    outcomes += [Outcome(f"other {i}", 0.0, True, True, "it has no colors", skipped=True) for i in range(20)]
    code, _, err = run("backends", "--check", "reference")
    assert code == 2 and "passes 1 of 21 cases, too few to tell whether it is right; of the others it says: it has no colors\n" in err
    refused(run("backends", "--check", "gpu"), "there is no backend 'gpu'")
    refused(run("backends", "--full"), "give --check NAME")


@pytest.mark.parametrize("full", [False, True])
def test_backends_check_goes_case_by_case_and_further_where_asked(full, run, monkeypatch):
    """So that a bar can show how far it is; in one thread, and then in as many as before."""
    asked, threads = [], torch.get_num_threads()

    def one(backend, cases, dtype, device):
        asked.append((list(cases), torch.get_num_threads()))
        return [Outcome(case, 0.0, True, True, "") for case in cases]

    monkeypatch.setattr(backends_module, "check_backend", one)
    torch.set_num_threads(2)
    assert run("backends", "--check", "reference", *(["--full"] if full else []))[0] == 0
    assert torch.get_num_threads() == 2
    torch.set_num_threads(threads)
    assert asked == [([case], 1) for case in [*CASES, *(MORE if full else [])]]


def test_list_says_where_names_come_from_and_what_is_wrong_with_one(run, tmp_path, monkeypatch):
    place = tmp_path / "stranger-1.0.dist-info"
    place.mkdir()
    (place / "METADATA").write_text("Metadata-Version: 2.1\nName: stranger\nVersion: 1.0\n")
    groups = ["viewers]\nspark = stranger:SPARK\nkiosk = stranger:KIOSK\n", "recipes]\nbrief = stranger:brief\n", "models]\nnpz = nobody:FAMILY\n"]
    groups.append("upsamplers]\nkiosk = stranger:KIOSK\n")
    (place / "entry_points.txt").write_text("\n".join(f"[mipmap_plugin.{group}" for group in groups))
    (tmp_path / "stranger.py").write_text("brief = lambda scale, network: dict(steps=3)\nKIOSK = ('spark', 'unity')\n")
    monkeypatch.syspath_prepend(tmp_path)
    code, out, err = run("list")
    assert (code, err) == (0, "")
    assert "recipes:      default, instant, paper, thorough\n              brief: stranger:brief of stranger 1.0\n" in out
    assert "kiosk: stranger:KIOSK of stranger 1.0\n" in out
    assert "spark: stranger:SPARK of stranger 1.0, not used: the name is taken by a built-in one; choose another\n" in out
    assert "npz: nobody:FAMILY of stranger 1.0, not used: 'npz' (nobody:FAMILY) cannot be loaded: ModuleNotFoundError" in out
    assert "kiosk: stranger:KIOSK of stranger 1.0, not used: upsampler 'kiosk' is of type tuple; make it a function" in out
    listed = json.loads(run("list", "recipes", "--json")[1])
    assert listed["recipes"]["of packages"] == {"brief": "stranger:brief of stranger 1.0"}


def test_every_registry_reads_a_group_that_is_told():
    assert sorted(registry_of(kind)[0].group for kind in KINDS) == [f"mipmap_plugin.{kinds}" for kinds in GROUPS]


def test_no_backend_is_named_as_the_choice_of_one():
    with pytest.raises(SettingsError, match="cannot be named 'auto', which stands for the fastest one; choose another name"):
        register_backend("auto", "theirs:Backend")
