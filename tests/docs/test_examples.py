"""What the examples bring, as a package would that is installed beside this one: by entry points alone, in the commands."""

import re
import runpy
import sys
from functools import partialmethod
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest
import tiny

from mipmap_plugin import cli, load_model, registry, wrap_model
from mipmap_plugin.scenes import write_cameras
from mipmap_plugin.wrap import Wrapped

pytestmark = pytest.mark.usefixtures("few_views")

EXAMPLES = Path(__file__).parents[2] / "examples"
SCRIPTS = ["adapt_checkpoint.py", *sorted(file.name for file in EXAMPLES.glob("register_*.py") if file.name != "register_backend.py")]
POINTS = [
    EntryPoint("careful", "register_backend:CarefulBackend", "mipmap_plugin.backends"),
    EntryPoint("npz", "register_family:FAMILY", "mipmap_plugin.models"),
    EntryPoint("brief", "register_recipe:brief", "mipmap_plugin.recipes"),
    EntryPoint("sharp", "register_upsampler:sharp", "mipmap_plugin.upsamplers"),
    EntryPoint("kiosk", "register_viewer:KIOSK", "mipmap_plugin.viewers"),
]


@pytest.fixture
def scene(tmp_path, monkeypatch):
    """A checkpoint of the example's family, and its cameras; the package is installed while the test lasts."""
    monkeypatch.syspath_prepend(EXAMPLES)
    monkeypatch.setattr(registry, "entry_points", lambda group: [point for point in POINTS if point.group == group])
    np.savez(tmp_path / "scene.npz", **{name: tensor.numpy() for name, tensor in tiny.model(40).parameters().items()})
    views = tiny.folder(tmp_path / "views", tiny.cameras())
    return [str(tmp_path / "scene.npz"), "--cameras", str(views / "cameras.json"), "--backend", "careful"]


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("adapt", ["--scale", "1/2", "--steps", "2", "--viewer", "classic"]),
        ("adapt", ["--scale", "2", "--steps", "1", "--upsampler", "sharp"]),
        ("adapt", ["--scale", "1/2", "--steps", "1", "--recipe", "brief"]),
        ("render", ["--scale", "1/2"]),
    ],
)
def test_all_of_it_works_together(scene, tmp_path, capsys, name, words):
    assert cli.main([name, *scene, *words, "--output", str(tmp_path / ("out.ply" if name == "adapt" else "out"))]) == 0, capsys.readouterr().err


def test_the_commands_that_list_know_of_it(scene, capsys):
    assert cli.main(["inspect", scene[0], "--no-viewers"]) == 0
    assert "splats:       40" in capsys.readouterr().out
    assert cli.main(["backends"]) == 0
    assert "careful" in capsys.readouterr().out
    assert cli.main(["list"]) == 0
    listed = capsys.readouterr().out
    assert all(f"{point.name}: {point.value}\n" in listed for point in POINTS)


@pytest.mark.parametrize("words", [["list"], ["list", "recipes", "--json"], ["backends"]])
def test_a_group_of_entry_points_that_is_misspelled_is_told(words, tmp_path, monkeypatch, capsys):
    (tmp_path / "stranger-1.0.dist-info").mkdir()
    (tmp_path / "stranger-1.0.dist-info" / "METADATA").write_text("Metadata-Version: 2.1\nName: stranger\nVersion: 1.0\n")
    (tmp_path / "stranger-1.0.dist-info" / "entry_points.txt").write_text("[mipmap_plugin.backend]\nmine = stranger:Mine\n")
    monkeypatch.syspath_prepend(tmp_path)
    assert cli.main(words) == 0
    told = "mine (stranger:Mine), in the group mipmap_plugin.backend of entry points, is not used: the groups are mipmap_plugin.backends,"
    assert told in capsys.readouterr().err


@pytest.mark.parametrize("module", ["register_family", "register_family_files"])
def test_cameras_beside_a_file_of_the_example_are_found(scene, tmp_path, module):
    load = runpy.run_path(str(EXAMPLES / f"{module}.py"))
    if module == "register_family_files":
        load["CholeskyModel"].from_gaussians(tiny.gaussians(40, degree=0)).save(scene[0], provenance={}, overwrite=True)
    write_cameras(tmp_path / "cameras.json", tiny.cameras(3))
    assert [view.name for view in wrap_model(load["load"](scene[0])).cameras] == ["view_0", "view_1", "view_2"]


def test_a_file_for_the_viewer_of_the_example(scene, tmp_path, capsys):
    scene[-1] = "reference"  # the example's backend draws what is classic only
    assert cli.main(["adapt", *scene, "--scale", "1/2", "--steps", "1", "--viewer", "kiosk", "--output", str(tmp_path / "out.ply")]) == 0
    assert "x0.5 in kiosk" in capsys.readouterr().out
    assert b'"viewer": "kiosk"' in (tmp_path / "out.ply").read_bytes()[:8192]


@pytest.mark.parametrize(
    ("name", "place", "given", "made"),
    [
        ("base", ".", "base/", "base_x0.5/point_cloud/iteration_30000/point_cloud.ply"),
        ("base", "base", ".", "base_x0.5/point_cloud/iteration_30000/point_cloud.ply"),
        ("base", ".", "base/point_cloud/iteration_30000", "base_iteration_30000_x0.5/point_cloud/iteration_30000/point_cloud.ply"),
        ("base.ply", ".", "base.ply", "base_x0.5.ply"),
    ],
)
def test_the_adapted_checkpoint_lies_beside_its_base(tmp_path, monkeypatch, name, place, given, made):
    tiny.model().save(tmp_path / name, provenance={})
    monkeypatch.chdir(tmp_path / place)
    monkeypatch.setattr(Wrapped, "adapt", partialmethod(Wrapped.adapt, steps=1))
    runpy.run_path(str(EXAMPLES / "adapt_checkpoint.py"))["main"](Path(given), 0.5)
    assert (tmp_path / made).is_file() and Path("after.png").is_file()


def test_the_demo_scene_can_be_trained(tmp_path):
    train = runpy.run_path(str(EXAMPLES / "train_demo_scene.py"))["main"]
    train(tmp_path / "demo", size=16, views=7, points=40, splats=30, steps=4)
    assert len(load_model(tmp_path / "demo")) <= 30


@pytest.mark.parametrize("script", SCRIPTS)
def test_a_script_ends_in_one_sentence_where_there_is_no_checkpoint(script, monkeypatch, capsys):
    words = ["1/4"] if script == "adapt_checkpoint.py" else ["--scale", "1/4"]
    monkeypatch.setattr(sys, "argv", [script, "nosuch", *words])
    with pytest.raises(SystemExit, match=r"^2$"):
        runpy.run_path(str(EXAMPLES / script), run_name="__main__")
    assert re.fullmatch(r"(mipmap-plugin: )?nosuch does not exist; give a PLY file or a model folder\n", capsys.readouterr().err)


@pytest.mark.parametrize(("words", "said"), [(["--views", "3"], "views 7, and points 4"), ([], "exists already")])
def test_what_the_demo_scene_cannot_be_trained_with_is_told_at_once(tmp_path, monkeypatch, capsys, words, said):
    monkeypatch.setattr(sys, "argv", ["train_demo_scene.py", str(tmp_path), *words])
    with pytest.raises(SystemExit, match=r"^2$"):
        runpy.run_path(str(EXAMPLES / "train_demo_scene.py"), run_name="__main__")
    assert said in capsys.readouterr().err


@pytest.mark.parametrize("file", sorted(EXAMPLES.glob("register_*.py")), ids=lambda file: file.stem)
def test_what_a_stranger_writes_is_short(file):
    text = file.read_text().split('"""', 2)[2]
    assert len([line for line in text.splitlines() if line.strip()]) <= 50
