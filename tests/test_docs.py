"""What README.md and docs/ say holds: commands parse and run, Python runs, links lead somewhere, and names exist. Nothing comes from the network."""

import ast
import builtins
import functools
import importlib
import inspect
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import pytest
import tiny
import torch

import mipmap_plugin
from mipmap_plugin import cli, wrap_model
from mipmap_plugin.adaptation.target.upsamplers import UPSAMPLERS
from mipmap_plugin.backends import BACKENDS
from mipmap_plugin.commands.adapt import Changes
from mipmap_plugin.commands.many import Many
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.effects import explain
from mipmap_plugin.formats.images import write_image
from mipmap_plugin.formats.splat_transform import find_tool
from mipmap_plugin.models.families import BUILT_IN
from mipmap_plugin.recipes import DEFAULT_OUT, RECIPES
from mipmap_plugin.splatting.viewers import VIEWERS
from mipmap_plugin.wrap import Wrapped

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
MOST_WORDS = 700  # of the README, which is read in two minutes

FENCE = re.compile(r"^```(\S*)[^\n]*\n(.*?)^```$", re.DOTALL | re.MULTILINE)
SPAN = re.compile(r"`([^`\n]+)`")
LINK = re.compile(r"\]\(([^)\s]+)\)")
SNIPPET = re.compile(r'^--8<-- "([^":]+)(?::(\w+))?"$', re.MULTILINE)
OPTION = re.compile(r"(?<![\w-])--[a-z][\w-]*")

COMMANDS = cli.COMMANDS
OTHER_PROGRAMS = {"pip", "python", "pytest", "ruff", "mypy", "npm", "mkdocs", "dask", "sbatch"}
OPTIONS_OF_OTHERS = {"--train_test_exp", "--antialiasing", "--resources"}  # INRIA's; dask's


@dataclass(frozen=True)
class Piece:
    """Something between backticks."""

    page: Path
    text: str

    def __str__(self) -> str:
        return f"{self.page.name}: {self.text.strip().splitlines()[-1]}"


def blocks(page: Path, *, python: bool) -> list[str]:
    return [text for language, text in FENCE.findall(page.read_text(encoding="utf-8")) if (language == "python") == python]


def shell_pieces(page: Path) -> list[Piece]:
    """Each command of a block, and each piece of code within a sentence or a table."""
    lines = [line for block in blocks(page, python=False) for line in block.splitlines()]
    spans = SPAN.findall(FENCE.sub("", page.read_text(encoding="utf-8")))
    return [Piece(page, part.strip()) for text in (*lines, *spans) for part in text.split("&&") if part.strip()]


SHELL = [piece for page in PAGES for piece in shell_pieces(page)]
HELP = [Piece(ROOT / "mipmap_plugin/cli.py", f"mipmap-plugin {name} {words}") for name, words in cli.EXAMPLES.items()]
CALLS = list({piece.text: piece for piece in SHELL if piece.text.startswith("mipmap-plugin ")}.values())
PYTHON = [Piece(page, block) for page in PAGES for block in blocks(page, python=True) if not SNIPPET.search(block)]


def test_the_readme_is_read_in_two_minutes():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").split()) <= MOST_WORDS


def test_set_up_is_two_commands():
    """What .ci/run and the tests of a fresh clone follow."""
    lines = [line for block in blocks(ROOT / "README.md", python=False) for line in block.splitlines()]
    assert lines[:2] == ["pip install -c constraints.txt . && mipmap-plugin demo", "pip install -c constraints.txt '.[test]' && pytest"]


def test_every_page_is_in_the_navigation():
    listed = set(re.findall(r": (\S+\.md)$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.MULTILINE))
    assert {page.name for page in PAGES[1:]} <= listed
    assert all((ROOT / "docs" / name).is_file() or (ROOT / name).is_file() for name in listed)


# Links


def anchors(page: Path) -> set[str]:
    """The anchors of headings, as python-markdown and Git hosts make them."""
    headings = re.findall(r"^#+ (.+)$", FENCE.sub("", page.read_text(encoding="utf-8")), re.MULTILINE)
    return {re.sub(r"[\s-]+", "-", re.sub(r"[^\w\s-]", "", heading.lower()).strip()) for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_to_what_is_there(page):
    for link in LINK.findall(FENCE.sub("", page.read_text(encoding="utf-8"))):
        if re.match(r"https?://", link):
            continue
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        assert target.exists() and ROOT in target.parents, link
        if anchor:
            assert anchor in anchors(target), link


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_snippets_are_there(page):
    for name, section in SNIPPET.findall(page.read_text(encoding="utf-8")):
        text = (ROOT / name).read_text(encoding="utf-8")
        assert not section or (f"--8<-- [start:{section}]\n" in text and f"--8<-- [end:{section}]\n" in text), name
        compile(text, name, "exec")


def test_modules_of_the_reference_are_there():
    for name in re.findall(r"^::: (\S+)$", (ROOT / "docs/api.md").read_text(encoding="utf-8"), re.MULTILINE):
        module, _, attribute = name.rpartition(".")
        assert hasattr(importlib.import_module(module), attribute), name


def undescribed(kind):
    """The public fields of a class that its docstring does not describe."""
    fields = [name for name in vars(kind).get("__annotations__", {}) if not name.startswith("_")]
    return [name for name in fields if not re.search(rf"^ +{name}: \S", kind.__doc__ or "", re.MULTILINE)]


def test_the_reference_describes_every_field_of_a_record():
    """Comments in the source are not on the site. Settings have descriptions of their own."""
    places = [name.rpartition(".") for name in re.findall(r"^::: (\S+)$", (ROOT / "docs/api.md").read_text(), re.MULTILINE)]
    kinds = [getattr(importlib.import_module(module), name) for module, _, name in places]
    records = [kind for kind in kinds if isinstance(kind, type) and not hasattr(kind, "model_fields")]
    assert {kind.__name__: names for kind in records if (names := undescribed(kind))} == {}


def test_all_that_is_exported_is_in_the_reference():
    text = (ROOT / "docs/api.md").read_text(encoding="utf-8")
    assert [name for name in mipmap_plugin.__all__ if f"::: mipmap_plugin.{name}\n" not in text] == []


# Commands


@pytest.fixture
def parse(monkeypatch):
    """Give words to the real parser; return the name of the command, which is not run, and its arguments."""
    calls = []

    def recorder(name, command):
        @functools.wraps(command)
        def record(**arguments):
            calls.append((name, arguments))

        return record

    monkeypatch.setattr(cli, "COMMANDS", {name: recorder(name, command) for name, command in COMMANDS.items()})

    def call(words):
        calls.clear()
        assert cli.main(words) == 0
        return calls[0] if calls else ("", {})

    return call


def is_mention(words: list[str]) -> bool:
    """`mipmap-plugin adapt` alone is the name of a command, and nothing that is run."""
    return len(words) == 1 and words[0] in COMMANDS


@pytest.mark.parametrize("call", [*HELP, *CALLS], ids=str)
def test_commands_parse(call, parse):
    words = shlex.split(call.text)[1:]
    if is_mention(words):
        return
    _, arguments = parse(words)
    for name, registry in {"recipe": RECIPES, "viewer": VIEWERS, "backend": BACKENDS, "check": BACKENDS}.items():
        named = arguments.get(name) or ()
        for each in [named] if isinstance(named, str) else named:
            assert each in (*registry.names(), "auto", "NAME"), each
    upsampler = arguments.get("upsampler") or "bicubic"
    assert upsampler in UPSAMPLERS.names() or upsampler.endswith(".pth")


def test_a_wrong_command_is_found(parse):
    for words in (["adapt", "scene.ply", "--scale", "big"], ["adapt", "scene.ply", "--sclae", "4"], ["adopt"], ["render", "scene.ply"]):
        with pytest.raises(SystemExit):
            parse(words)


def test_there_are_commands_to_check():
    assert len(COMMANDS) == 10 and {shlex.split(call.text)[1] for call in CALLS} >= set(COMMANDS)


def options() -> set[str]:
    """Those of all commands."""
    parameters = {name for command in COMMANDS.values() for name in inspect.signature(command).parameters} | set(vars(Many())) | set(vars(Changes()))
    names = {name.replace("_", "-") for name in parameters}
    return {f"--{name}" for name in names} | {f"--no-{name}" for name in names} | {"--help", "--version", "--quiet", "--log"}


def test_options_exist():
    ours = [piece for piece in SHELL if piece.text.split()[0] not in OTHER_PROGRAMS]
    absent = [(str(piece), each) for piece in ours for each in OPTION.findall(piece.text) if each not in options() | OPTIONS_OF_OTHERS]
    assert absent == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_recipes_viewers_and_settings_exist(page):
    text = page.read_text(encoding="utf-8")
    for word, registry in {"recipe": RECIPES, "viewer": VIEWERS}.items():
        assert set(re.findall(rf'(?:--{word} |\b{word}=")([a-z][\w-]*)', text)) <= set(registry.names())
    arguments = {*inspect.signature(Wrapped.adapt).parameters, *inspect.signature(wrap_model).parameters, *AdaptConfig.model_fields, "eval"}
    assert set(re.findall(r"`(\w+)=[^`]+`", text)) <= arguments


def test_the_number_of_effects_is_that_of_inspect():
    model = wrap_model(files("mipmap_plugin.demo").joinpath("base.ply"))
    told = re.search(r"Of the (\d+), flowers", (ROOT / "docs/tradeoffs.md").read_text(encoding="utf-8"))
    assert int(told[1]) == len(explain(model.effects(), model.model.gaussians(model.any_camera())))


def test_scripts_that_are_named_exist():
    scripts = {piece.text.split()[1] for piece in SHELL if piece.text.startswith("python ") and len(piece.text.split()) > 1}
    assert scripts and all((ROOT / script).is_file() for script in scripts)


def test_pages_name_every_recipe_viewer_backend_and_family():
    pages = {page.stem: page.read_text(encoding="utf-8") for page in PAGES}
    code = "from mipmap_plugin import backends, recipes; from mipmap_plugin.splatting import viewers; "
    code += "print([each.names() for each in (recipes.RECIPES, viewers.VIEWERS, backends.BACKENDS)])"  # without what other tests register
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    recipes, viewers, backends = ast.literal_eval(done.stdout)
    assert [name for name in recipes if f"| `{name}` |" not in pages["recipes"]] == []
    assert [name for name in viewers if f"`{name}`" not in pages["viewers"]] == []
    assert [name for name in backends if f"| `{name}` |" not in pages["backends"]] == []
    titles = {"3DGS", "2DGS", "GOF", "Deformable-3D-Gaussians", "4DGaussians", "splatfacto"}
    titles |= {each.title for each in BUILT_IN if each.load and each.name in ("mip", "analytic", "scaffold", "octree", "gsplat")}
    assert [title for title in titles if title not in pages["families"] or title not in pages["README"]] == []


# Python


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


# A ladder of levels takes half a minute.
LONG = [pytest.param(piece, marks=[pytest.mark.slow] if ".levels(" in piece.text else []) for piece in PYTHON]


@pytest.mark.parametrize("piece", LONG, ids=str)
@pytest.mark.usefixtures("few_views")
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


# What runs, on the scene that comes along

NOT_RUN = {
    "view": "serves a page until Ctrl-C; tests/browser/test_live_view.py",
    "demo": "run by .ci/run and tests/test_demo.py",
    "--full": "several minutes; tests/hard has it",
    "NAME": "stands for a name",
    "phone.spz": "splat-transform may not be installed",
    "SwinIR_x2.pth": "no network comes along",
    "FILE": "no weights come along",
    "results/garden": "no checkpoint of gsplat comes along",
    "scenes.txt": "no list comes along",
    "tcp://scheduler:8786": "no scheduler runs here",
    "outputs/poster/splatfacto/2026-11-01_120000": "no checkpoint of splatfacto comes along",
}
FOLDERS = ("CHECKPOINT", "output/bicycle", "output/city", "lego_200")
FILES = ("scene.ply", "point_cloud.ply")


def runs(call: Piece) -> bool:
    words = shlex.split(call.text)[1:]
    return not is_mention(words) and not NOT_RUN.keys() & set(words)


@pytest.fixture(scope="module")
def demo_scene(tmp_path_factory):
    """What the commands name, made of the embedded scene: checkpoints, cameras, and photographs, which the base itself shows."""
    home, here = Path(str(files("mipmap_plugin.demo"))), tmp_path_factory.mktemp("scene")
    for name in FOLDERS:
        ply = here / name / "point_cloud/iteration_30000/point_cloud.ply"
        ply.parent.mkdir(parents=True)
        shutil.copy(home / "base.ply", ply)
        shutil.copy(home / "cameras.json", here / name)
        (here / name / "cfg_args").write_text("Namespace(sh_degree=3, resolution=-1, white_background=True, eval=True)")
    for name in FILES:
        shutil.copy(home / "base.ply", here / name)
    (here / "data/bicycle").mkdir(parents=True)
    shutil.copy(home / "cameras.json", here / "data/bicycle")
    for name in ("images", "lego"):
        write_photographs(here / name, wrap_model(here / FOLDERS[0]))
    return here


def write_photographs(folder: Path, base: Wrapped) -> None:
    frames = []
    for view in [view for view in base.cameras if view.split == "test"][:3]:
        pose = torch.linalg.inv(view.viewmat) @ torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
        frames.append({"file_path": f"./test/{view.name}", "transform_matrix": pose.tolist(), "fl_x": view.fx, "fl_y": view.fy})
        write_image(folder / "test" / f"{view.name}.png", base.render(view).image)
    (folder / "transforms_test.json").write_text(json.dumps({"frames": frames}))


@pytest.mark.slow
@pytest.mark.parametrize("call", [call for call in CALLS if runs(call)], ids=str)
def test_commands_run(call, demo_scene, tmp_path, monkeypatch, capsys):
    """As they are written, but for as few steps and repetitions as there can be, and with a folder for each `DIR`."""
    if "tradeoff" in call.text:
        pytest.importorskip("matplotlib")
    if {"--streamed-sog", "--tiles"} & set(call.text.split()) and "levels" in call.text and find_tool() is None:
        pytest.skip("splat-transform is not installed")
    monkeypatch.chdir(demo_scene)
    words = shlex.split(call.text)[1:]
    for place, word in enumerate(words):
        if word == "DIR":
            words[place] = "images" if words[place - 1] == "--images" else str(tmp_path / "results")
    for extra in (["--steps", "3"], ["--repeats", "1"]):
        if extra[0][2:] in inspect.signature(COMMANDS[words[0]]).parameters and extra[0] not in words:
            words += extra
    words += ["--overwrite"] if "overwrite" in inspect.signature(COMMANDS[words[0]]).parameters else []
    assert cli.main(words) == 0, capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("piece", PYTHON, ids=str)
def test_python_runs_on_the_embedded_scene(piece, demo_scene, tmp_path, monkeypatch):
    os.makedirs(tmp_path / "output")
    shutil.copytree(demo_scene / "output/bicycle", tmp_path / "output/bicycle")
    monkeypatch.chdir(tmp_path)
    exec(compile(piece.text, str(piece), "exec"), {"__name__": "block"})
