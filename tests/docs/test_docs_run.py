"""What README.md and docs/ show runs, Python and commands, on scenes that adapt in a moment."""

import ast
import builtins
import importlib
import shlex
from pathlib import Path

import pytest
import tiny
from docs_pages import CALLS, PYTHON, Piece, is_mention, options
from torch_checkpoints import gsplat_folder, splatfacto_folder, splats

from mipmap_plugin import cli, wrap_model
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.formats.splat_transform import LOD_META, refuse_exchange
from mipmap_plugin.recipes import DEFAULT_OUT
from mipmap_plugin.scenes import write_cameras


def unresolved(code: str) -> list[str]:
    """Names that nothing in a block defines, and what it imports that is not there."""
    tree = ast.parse(code)
    names = [node for node in ast.walk(tree) if isinstance(node, ast.Name)]
    known, absent = {*dir(builtins), *(node.id for node in names if isinstance(node.ctx, ast.Store))}, []
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            known |= {alias.asname or alias.name for alias in node.names}
            absent += [alias.name for alias in node.names if not hasattr(importlib.import_module(node.module), alias.name)]
        known |= {node.name} if isinstance(node, ast.FunctionDef) else {node.arg} if isinstance(node, ast.arg) else set()
        if isinstance(node, ast.Import):
            known |= {(alias.asname or alias.name).split(".")[0] for alias in node.names}
    return absent + [node.id for node in names if isinstance(node.ctx, ast.Load) and node.id not in known]


@pytest.mark.parametrize("piece", PYTHON, ids=str)
@pytest.mark.usefixtures("few_views", "brief_ladders")
def test_python_runs(piece, tmp_path, monkeypatch):
    """On a scene that adapts in a moment, in place of the reader's; a time budget has room for no more steps than usual."""
    assert unresolved(piece.text) == []
    tiny.folder(tmp_path / "output/bicycle", tiny.cameras(6))
    monkeypatch.setitem(DEFAULT_OUT, "steps", 20)
    monkeypatch.setitem(DEFAULT_OUT, "most_steps", 20)
    monkeypatch.chdir(tmp_path)
    exec(compile(piece.text, str(piece), "exec"), {"__name__": "block"})


def test_a_wrong_name_is_found():
    assert unresolved("from mipmap_plugin import wrap_model, wrap_it\nprint(wrap_model, modle)") == ["wrap_it", "modle"]


# The commands

NOT_RUN = {
    "view": "serves a page until Ctrl-C; tests/browser/test_live_view.py",
    "demo": "run by .ci/run and tests/demo/test_demo.py",
    "--full": "several minutes; tests/backends/test_conformance.py",
    "NAME": "stands for a name",
    "phone.spz": "splat-transform may not be installed",
    "SwinIR_x2.pth": "no network comes along",
    "FILE": "no weights come along",
    "tcp://scheduler:8786": "no scheduler runs here",
}
FOLDERS = ("CHECKPOINT", "output/bicycle", "output/city", "lego_200")
FILES = ("scene.ply", "point_cloud.ply")
SPLATS = 70  # enough for 64 tiles


def runs(call: Piece) -> bool:
    words = shlex.split(call.text)[1:]
    return not is_mention(words) and not NOT_RUN.keys() & set(words)


RUN = [call for call in CALLS if runs(call)]

# What takes more than a second or two: ladders, measurements, all checks of a backend, and processes that load torch.
LONG = {"levels", "evaluate", "tradeoff", "backends", "--jobs", "--dask"}


def shortened(words: list[str]) -> list[str]:
    """A command with as few steps and repetitions as there can be, which may replace what another one wrote."""
    known = options(words[0])
    for name, least in {"steps": "3", "repeats": "1"}.items():
        words = [*words, f"--{name}", least] if name in known and f"--{name}" not in words else words
    return [*words, "--overwrite"] if "overwrite" in known else words


def test_every_command_that_takes_steps_takes_few():
    shown = {words[0]: shortened(words) for words in (shlex.split(call.text)[1:] for call in RUN)}
    assert {name for name, words in shown.items() if "--steps" in words} == {"adapt", "levels", "evaluate", "tradeoff"}


@pytest.fixture(scope="module")
def small_scene(tmp_path_factory):
    """What the commands name: checkpoints, cameras, and photographs, which the base itself shows."""
    here = tmp_path_factory.mktemp("scene")
    views = tiny.cameras(6) + tiny.cameras(3, seed=9, split="test")
    for name in FOLDERS:
        tiny.folder(here / name, views, count=SPLATS)
        (here / name / "cfg_args").write_text("Namespace(sh_degree=1, resolution=-1, white_background=True, eval=True)")
    for name in FILES:
        tiny.ply(here / name)
    (here / "scenes.txt").write_text("output/bicycle\nlego_200\n")
    gsplat_folder(here / "results/garden", splats(), normalized="false")
    run = splatfacto_folder(here / "outputs/poster/splatfacto/2026-11-01_120000", splats())
    (run / "dataparser_transforms.json").write_text('{"scale": 1, "transform": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]}')
    for name in ("bicycle", "garden", "poster"):
        (here / "data" / name).mkdir(parents=True)
        write_cameras(here / "data" / name / "cameras.json", views)
    base = wrap_model(here / FOLDERS[0])
    for name in ("images", "lego"):
        tiny.write_photographs(here / name, "test", [view for view in base.cameras if view.split == "test"], lambda view: base.render(view).image)
    return here


def skip_without_splat_transform(words: list[str]) -> None:
    """Skip a command for whose files splat-transform is not installed, or too old, as it is beside an old Node.js."""
    for option, written in {"--streamed-sog": LOD_META, "--tiles": "tile.spz"}.items():
        if words[0] == "levels" and option in words:
            try:
                refuse_exchange(Path(written))
            except SettingsError as error:
                pytest.skip(str(error))


@pytest.mark.usefixtures("brief_ladders")
@pytest.mark.parametrize("call", [pytest.param(call, marks=[pytest.mark.slow] if LONG & set(call.text.split()) else []) for call in RUN], ids=str)
def test_commands_run(call, small_scene, tmp_path, monkeypatch, capsys, request):
    """As they are written, but `shortened` and in few views, and with a folder for each `DIR`."""
    if not {"--jobs", "--dask"} & set(call.text.split()):
        request.getfixturevalue("few_views")  # of this process alone
    if "tradeoff" in call.text:
        pytest.importorskip("matplotlib")
    words = shlex.split(call.text)[1:]
    skip_without_splat_transform(words)
    monkeypatch.chdir(small_scene)
    for place, word in enumerate(words):
        if word == "DIR":
            words[place] = "images" if words[place - 1] == "--images" else str(tmp_path / "results")
    assert cli.main(shortened(words)) == 0, capsys.readouterr().err
