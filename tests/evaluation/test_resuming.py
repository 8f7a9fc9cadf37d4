"""Evaluate and tradeoff after Ctrl-C and kill -9: the same command goes on with the cell that was in progress, and comes to the same results."""

import json
import os
import signal
import subprocess
import sys
from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import Mock

import pytest
import tiny
from running import wait_until

from mipmap_plugin.adaptation.target.upsamplers import network_input
from mipmap_plugin.cli import main
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.errors import OutputError
from mipmap_plugin.evaluation import cells
from mipmap_plugin.evaluation.cells import Cells, made_by
from mipmap_plugin.evaluation.evaluate import _adapted_rows, training_free_rows
from mipmap_plugin.evaluation.measure import adapt_alone
from mipmap_plugin.evaluation.protocols import PROTOCOLS
from mipmap_plugin.formats import staging
from mipmap_plugin.formats.torch_file import load_torch
from mipmap_plugin.recipes import RECIPES
from mipmap_plugin.wrap import wrap_model


@pytest.fixture
def folder(tmp_path):
    """A base and photographs of it."""
    tiny.folder(tmp_path / "base", tiny.cameras(3))
    tiny.scene(tmp_path / "scene", train=tiny.cameras(2), count=30)
    return tmp_path


def evaluate(folder, output):
    words = ["evaluate", folder / "base", "--images", folder / "scene", "--scale", "1/2", "--recipe", "paper", "--steps", "20"]
    return [*map(str, words), "--output", str(folder / output)]


def tradeoff(folder, output):
    words = ["tradeoff", folder / "base", "--scale", "1/2", "--recipe", "default", "--steps", "20"]
    words += ["--output", folder / output, "--supersampling", "2", "--repeats", "1", "--views", "1"]
    return [*map(str, words), "--no-renderers", "--no-picture"]


def stopped(words, number, cells, at_least):
    """Run a command until so many cells are kept, and send it a signal; return what it said."""
    command = [sys.executable, "-X", "faulthandler", "-m", "mipmap_plugin", *words]  # which says where a process was that aborts
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        wait_until(lambda: len(list(cells.glob("*.pt"))) >= at_least or process.poll() is not None)
        assert process.poll() is None, process.communicate()[1]
        os.kill(process.pid, number)
        _, said = process.communicate(timeout=120)
    finally:
        process.kill()
    return process.returncode, said


def rows_of(folder, *options):
    """The rows of an evaluation by a command that writes them anew, and keeps its cells."""
    words = ["evaluate", str(folder / "base"), "--images", str(folder / "scene"), "--scale", "1/2", *options]
    assert main([*words, "--output", str(folder / "rows.json"), "--overwrite"]) == 0
    return json.loads((folder / "rows.json").read_text())["rows"]


def untimed(rows):
    return [{name: value for name, value in row.items() if name not in ("adapt_seconds", "ms_per_view")} for row in rows]


@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGKILL, marks=pytest.mark.slow)], ids=["ctrl-c", "kill -9"])
def test_evaluate_goes_on_where_it_stopped(folder, capsys, number):
    kept = folder / "rows.json.resume"
    code, said = stopped(evaluate(folder, "rows.json"), number, kept, 3)
    before = {path.name: path.stat().st_mtime_ns for path in kept.glob("*.pt")}
    assert len(before) >= 3 and not (folder / "rows.json").exists()
    if number == signal.SIGINT:
        assert code == 130, said
        assert f"interrupted with {len(before)} rows finished; run the same command again to go on" in said
    assert main(evaluate(folder, "rows.json")) == 0
    assert f"rows.json.resume has {len(before)} rows of a command that was interrupted" in capsys.readouterr().err
    assert not kept.exists() and (folder / "rows.html").exists()
    assert main(evaluate(folder, "whole.json")) == 0
    interrupted, whole = (json.loads((folder / name).read_text())["rows"] for name in ("rows.json", "whole.json"))
    assert untimed(interrupted) == untimed(whole)


def test_tradeoff_goes_on_where_it_was_killed(folder, capsys):
    kept = folder / "new" / "tradeoff.resume"
    stopped(tradeoff(folder, "new"), signal.SIGKILL, kept, 3)
    points = [point for path in kept.glob("*.pt") for point in load_torch(path)["points"]]
    assert main(tradeoff(folder, "new")) == 0
    assert "cells of a command that was interrupted" in capsys.readouterr().err and not kept.exists()
    [told] = json.loads((folder / "new" / "tradeoff.json").read_text())["scales"]
    timed = {(point["name"], point["step"]): point["ms_per_frame"] for point in told["points"]}
    assert len(points) >= 3 and all(timed[point["name"], point["step"]] == point["ms_per_frame"] for point in points)  # the same measurement


@pytest.mark.parametrize("command", [evaluate, tradeoff])
def test_a_folder_with_other_things_is_not_deleted(folder, capsys, command):
    kept = folder / "rows.json.resume" if command is evaluate else folder / "rows.json" / "tradeoff.resume"
    kept.mkdir(parents=True)
    (kept / "letter.txt").write_text("mine")
    assert main(command(folder, "rows.json")) == 2
    assert "holds something else" in capsys.readouterr().err and (kept / "letter.txt").exists()


def test_rows_of_another_background_are_measured_again(folder, monkeypatch):
    """Which is not in the checkpoint's own bytes."""
    monkeypatch.setattr(staging, "_remove", lambda *_: None)
    psnrs = []
    for white in (False, True):
        options = folder / "base" / "cfg_args"
        options.write_text(options.read_text().replace("white_background=False", f"white_background={white}"))
        psnrs.append(rows_of(folder)[0]["psnr_db"])
    assert psnrs[0] != psnrs[1]


def test_rows_of_another_truth_are_measured_again(folder, monkeypatch):
    """As of an older version, whose protocol made another of the same photographs."""
    monkeypatch.setattr(staging, "_remove", lambda *_: None)
    rows = []
    for truncate in (False, True, True):
        monkeypatch.setitem(PROTOCOLS, "P1", replace(PROTOCOLS["P1"], truncate=truncate))
        rows.append(rows_of(folder, "--protocol", "P1")[0])
    assert rows[0]["psnr_db"] != rows[1]["psnr_db"] and rows[1] == rows[2]  # the last is not measured again


@pytest.mark.parametrize(("command", "module"), [("evaluate", "evaluate"), ("tradeoff", "tradeoff.measuring")])
def test_what_another_recipe_of_that_name_made_is_measured_again(folder, monkeypatch, command, module):
    """One's own recipe, edited after an interruption."""
    words = [command, str(folder / "base"), "--images", str(folder / "scene"), "--scale", "1/2", "--recipe", "mine"]
    words += ["--no-picture", "--no-renderers", "--repeats", "1", "--supersampling", "2"] if command == "tradeoff" else []
    monkeypatch.setattr(staging, "_remove", lambda *_: None)
    made, counts = [], []
    place = f"mipmap_plugin.evaluation.{module}.adapt_alone"
    monkeypatch.setattr(place, lambda *args, **settings: made.append(args) or adapt_alone(*args, **settings))
    for crispness in (0.0, 0.0, 0.5):
        settings = {"steps": 0, "views": "given", "crispness": crispness}
        RECIPES.add("mine", lambda scale, network, settings=settings: settings, replace=True)
        assert main([*words, "--output", str(folder / "rows"), "--overwrite"]) == 0
        counts.append(len(made))
    assert 0 < counts[0] == counts[1] and counts[2] == 2 * counts[0]


def test_a_command_that_ends_between_its_two_files_is_not_in_its_own_way(folder, capsys, monkeypatch):
    words = ["evaluate", str(folder / "base"), "--images", str(folder / "scene"), "--scale", "1/2", "--output", str(folder / "rows.json")]
    with monkeypatch.context() as failing:
        failing.setattr("mipmap_plugin.commands.evaluate.write_json", Mock(side_effect=OutputError("the disk is full")))
        assert main(words) == 2
    assert main(words) == 0, capsys.readouterr().err
    assert {path.name for path in folder.iterdir()} == {"base", "scene", "rows.json", "rows.html"}


@pytest.mark.parametrize("given", ["scene/transforms_test.json", "scene/test/view_0.png", "cameras.json"])
def test_what_rows_are_measured_from_is_not_replaced_by_them(folder, capsys, given):
    (folder / "base" / "cameras.json").rename(folder / "cameras.json")
    before = (folder / given).read_bytes()
    assert main([*evaluate(folder, given), "--cameras", str(folder / "cameras.json"), "--overwrite"]) == 2
    assert "never replaced" in capsys.readouterr().err and (folder / given).read_bytes() == before


def test_rows_and_page_are_two_files(folder, capsys):
    assert main(evaluate(folder, "rows.html")) == 2
    assert "give the rows another name" in capsys.readouterr().err and not (folder / "rows.html").exists()


def test_a_finished_command_is_not_replaced(folder):
    assert main(tradeoff(folder, "new")) == 0
    (folder / "new" / "tradeoff.resume").mkdir()
    assert main(tradeoff(folder, "new")) == 2


def test_a_cell_is_found_by_all_that_it_depends_on(tmp_path, monkeypatch):
    Cells(tmp_path, {"base": "a"}).keep({"row": "base", "scale": 0.5}, {"psnr": 1.0})
    assert Cells(tmp_path, {"base": "a"}).find({"scale": 0.5, "row": "base"}) == {"psnr": 1.0}
    assert Cells(tmp_path, {"base": "b"}).find({"row": "base", "scale": 0.5}) is None
    assert Cells(tmp_path, {"base": "a"}).find({"row": "base", "scale": 0.25}) is None
    with monkeypatch.context() as patched:
        patched.setattr(cells, "versions", lambda: {"mipmap_plugin": "another"})
        assert Cells(tmp_path, {"base": "a"}).find({"row": "base", "scale": 0.5}) is None
    [file] = tmp_path.iterdir()
    file.write_bytes(file.read_bytes()[:-9])
    assert Cells(tmp_path, {"base": "a"}).find({"row": "base", "scale": 0.5}) is None


def test_cells_of_another_network_of_that_name_are_not_found(tmp_path):
    network, keys = tmp_path / "net.pth", []
    for content in (b"one", b"one", b"other"):
        network.write_bytes(content)
        keys.append(made_by(AdaptConfig(upsampler=str(network))))
    assert keys[0] == keys[1] != keys[2]


@pytest.mark.parametrize(("rows", "key"), [(training_free_rows, ()), (_adapted_rows, (["instant"],))])
def test_rows_are_kept_by_the_network_that_made_them(tmp_path, rows, key):
    (tmp_path / "net.pth").write_bytes(b"one")
    keys, settings = [], {"upsampler": str(tmp_path / "net.pth")}
    judge = SimpleNamespace(cell=lambda key, measure: keys.append(str(key)), protocol=PROTOCOLS["P3"])
    rows(wrap_model(tiny.model(5), cameras=tiny.cameras(1)), judge, 2.0, *key, **({"settings": settings} if key else settings))
    assert keys and all(network_input(settings["upsampler"])["network"] in key for key in keys)


def test_without_a_place_nothing_is_kept(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    cells = Cells()
    cells.keep({"row": "base"}, {"psnr": 1.0})
    assert cells.find({"row": "base"}) is None and not list(tmp_path.iterdir())
