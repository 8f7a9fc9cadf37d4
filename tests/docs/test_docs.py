"""What README.md and docs/ say holds: commands parse, links lead somewhere, and names exist. Nothing comes from the network."""

import functools
import importlib
import inspect
import re
import shlex
from importlib.resources import files
from pathlib import Path

import pytest
from docs_pages import CALLS, COMMANDS, PAGES, ROOT, SHELL, SNIPPET, Piece, blocks, is_mention, options, prose

import mipmap_plugin
from mipmap_plugin import cli, wrap_model
from mipmap_plugin.adaptation.target.upsamplers import UPSAMPLERS
from mipmap_plugin.backends import BACKENDS
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.effects import explain
from mipmap_plugin.models.families import BUILT_IN
from mipmap_plugin.recipes import RECIPES
from mipmap_plugin.splatting.viewers import VIEWERS
from mipmap_plugin.wrap import Wrapped

MOST_WORDS = 700  # of the README, which is read in two minutes

LINK = re.compile(r"\]\(([^)\s]+)\)")
OPTION = re.compile(r"(?<![\w-])--[a-z][\w-]*")

OTHER_PROGRAMS = {"pip", "python", "pytest", "ruff", "mypy", "npm", "mkdocs", "dask", "sbatch"}
OPTIONS_OF_OTHERS = {"--train_test_exp", "--antialiasing", "--resources", "--keep-crs"}  # INRIA's; dask's; OpenSplat's


HELP = [Piece(ROOT / "mipmap_plugin/cli.py", f"mipmap-plugin {name} {words}") for name, words in cli.EXAMPLES.items()]


def test_the_readme_is_read_in_two_minutes():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").split()) <= MOST_WORDS


def test_set_up_is_two_commands():
    """What .ci/run and the tests of a fresh clone follow."""
    lines = [line for block in blocks(ROOT / "README.md", python=False) for line in block.splitlines()]
    assert lines[:2] == ["pip install -c constraints.txt . && mipmap-plugin demo", 'pip install -c constraints.txt ".[test]" && pytest']


def test_every_page_is_in_the_navigation():
    listed = set(re.findall(r": (\S+\.md)$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.MULTILINE))
    assert {page.name for page in PAGES[1:]} <= listed
    assert all((ROOT / "docs" / name).is_file() or (ROOT / name).is_file() for name in listed)


# Links


def anchors(page: Path) -> set[str]:
    """The anchors of headings, as python-markdown and Git hosts make them."""
    headings = re.findall(r"^#+ (.+)$", prose(page), re.MULTILINE)
    return {re.sub(r"[\s-]+", "-", re.sub(r"[^\w\s-]", "", heading.lower()).strip()) for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_to_what_is_there(page):
    for link in LINK.findall(prose(page)):
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


def undescribed(kind):
    """The public fields of a class that its docstring does not describe."""
    fields = [name for name in vars(kind).get("__annotations__", {}) if not name.startswith("_")]
    return [name for name in fields if not re.search(rf"^ +{name}: \S", kind.__doc__ or "", re.MULTILINE)]


def test_the_reference_describes_every_field_of_a_record():
    """Comments in the source are not on the site. Settings have descriptions of their own. What is not there has no attribute."""
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
        with pytest.raises((SystemExit, AssertionError)):
            parse(words)


def test_there_are_commands_to_check():
    assert len(COMMANDS) == 10 and {shlex.split(call.text)[1] for call in CALLS} >= set(COMMANDS)


def options_of_all() -> set[str]:
    """Those of all commands, as they are typed."""
    names = {name.replace("_", "-") for command in COMMANDS for name in options(command)}
    return {f"--{name}" for name in names} | {f"--no-{name}" for name in names} | {"--help", "--version", "--quiet", "--log"}


def test_options_exist():
    ours = [piece for piece in SHELL if piece.text.split()[0] not in OTHER_PROGRAMS]
    absent = [(str(piece), each) for piece in ours for each in OPTION.findall(piece.text) if each not in options_of_all() | OPTIONS_OF_OTHERS]
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
    scripts = {piece.text.split()[1] for piece in SHELL if piece.text.startswith("python ") and len(piece.text.split()) > 1} - {"-m"}
    assert scripts and all((ROOT / script).is_file() for script in scripts)


def test_pages_name_every_recipe_viewer_backend_and_family():
    pages = {page.stem: page.read_text(encoding="utf-8") for page in PAGES}
    assert [name for name in RECIPES.names() if f"| `{name}` |" not in pages["recipes"]] == []
    assert [name for name in VIEWERS.names() if f"`{name}`" not in pages["viewers"]] == []
    backends = {*BACKENDS.names()} - {"gsplat-twins"}  # of the benchmarks, which other tests import
    assert [name for name in backends if f"| `{name}` |" not in pages["backends"]] == []
    titles = {"3DGS", "2DGS", "GOF", "Deformable-3D-Gaussians", "4DGaussians", "splatfacto"}
    titles |= {each.title for each in BUILT_IN if each.load and each.name in ("mip", "analytic", "scaffold", "octree", "gsplat")}
    assert [title for title in titles if title not in pages["families"] or title not in pages["README"]] == []
