"""The house's own rules, read from the source: what may import what, and how large a thing may grow."""

import ast
import inspect
import re
import subprocess
import sys
from collections.abc import Callable
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import get_type_hints

import tiny
from pydantic import validate_call

import mipmap_plugin
from mipmap_plugin.models import Traits, load_model

PACKAGE = Path(__file__).parents[1] / "mipmap_plugin"
MODULES = sorted(PACKAGE.rglob("*.py"))

# From the ground up; a module imports only what lies below its own storey, or in its own package.
STOREYS = [
    {"errors"},
    {"limits", "process", "morton"},
    {"registry", "config", "progress", "screen_filters", "allowed", "plugin_errors"},
    {"render_settings"},
    {"gaussians", "camera"},
    {"formats"},
    {"effects"},
    {"splatting"},
    {"backends", "models", "scenes"},
    {"recipes"},
    {"adaptation"},
    {"frozen_base"},
    {"levels"},
    {"wrap"},
    {"evaluation", "models.conformance"},
    {"pages", "jobs"},
    {"tiles", "viewing"},
    {"demo"},
    {"commands"},
    {"cli"},
    {"__main__"},
]

# Where each outside library may be imported; torch and the standard library may be anywhere.
CONFINED = {
    "PIL": ["formats/images.py"],
    "dask": ["jobs/farm.py"],
    "distributed": ["jobs/farm.py"],
    "gsplat": ["backends/gsplat"],
    "llvmlite": ["backends/cpu_kernels/"],
    "lpips": ["evaluation/perceptual.py"],
    "matplotlib": ["adaptation/plot.py", "evaluation/tradeoff/plot.py"],
    "numba": ["backends/cpu_kernels/"],
    "numpy": ["backends/", "evaluation/metrics.py", "formats/", "models/", "process/pool.py"],
    "plyfile": ["formats/ply.py"],
    "pycolmap": ["scenes/"],
    "pydantic": ["config.py", "adaptation/curve.py", "adaptation/report.py", "jobs/finished.py"],
    "pytest": ["backends/conformance/suite.py", "models/conformance.py"],
    "safetensors": ["adaptation/target/super_resolution.py"],
    "skimage": ["evaluation/metrics.py"],
    "spandrel": ["adaptation/target/super_resolution.py"],
    "tqdm": ["progress.py"],
    "triton": ["backends/triton"],
    "tyro": ["cli.py", "commands/"],
    "typing_extensions": ["frozen_base.py", "wrap.py"],
    "viser": ["viewing/server.py"],
    "websockets": ["viewing/server.py"],
}

MAX_FILE, MAX_FUNCTION = 300, 60  # lines
MAX_ARGUMENTS = 6

# Where functions may have more: kernels, which numba and Triton give no records, the commands, whose arguments are options, and the door.
MANY_ARGUMENTS = ("backends/cpu_kernels/", "backends/triton_kernels/", "commands/", "frozen_base.py: adapt")


def name_of(path: Path) -> str:
    return path.relative_to(PACKAGE).as_posix()


@cache
def nodes(path: Path) -> list[ast.AST]:
    """Of the syntax of a file."""
    return list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))


@cache
def imports(path: Path) -> set[str]:
    """The full names of the modules that a file imports, at its top or inside its functions, with `import_module` too."""
    found = set()
    for node in nodes(path):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: imports are absolute"
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
        if isinstance(node, ast.Call) and ast.unparse(node.func).split(".")[-1] == "import_module":
            found |= {each.value for each in node.args if isinstance(each, ast.Constant) and each.value.startswith(PACKAGE.name)}
    return found


def room(name: str) -> str:
    """The part of the package that a full name or a path lies in. What strangers check their families with goes all the way, up to adapting."""
    inner = name.removeprefix("mipmap_plugin.").replace("/", ".").removesuffix(".py")
    return "models.conformance" if inner.startswith("models.conformance") else inner.split(".")[0]


def storey(part: str) -> int:
    return next(level for level, parts in enumerate(STOREYS) if part in parts)


def breaches(name: str, imported: set[str]) -> list[str]:
    """The imports of a file that lead upwards or across."""
    ours = {room(each) for each in imported if each.startswith("mipmap_plugin.")} - {room(name)}
    return sorted(other for other in ours if storey(other) >= storey(room(name)))


def offenders(found: Callable[[Path], list[str]], paths: list[Path] = MODULES) -> dict[str, list[str]]:
    """What is found in files against a rule, by their names."""
    return {name_of(path): wrong for path in paths if (wrong := found(path))}


def test_imports_lead_downwards():
    below = [path for path in MODULES if path != PACKAGE / "__init__.py"]
    assert offenders(lambda path: breaches(name_of(path), imports(path)), below) == {}


def test_settings_name_their_defaults():
    """Type checkers know no other (PEP 681): to them a default by place is a setting that has to be given."""
    fields = [node for node in nodes(PACKAGE / "config.py") if isinstance(node, ast.Call) and ast.unparse(node.func) == "Field"]
    assert fields and [ast.unparse(field) for field in fields if field.args] == []


def test_a_breach_would_be_found():
    assert breaches("scenes/base.py", {"mipmap_plugin.models.base.SplatModel", "mipmap_plugin.camera.Camera"}) == ["models"]
    assert breaches("wrap.py", {"mipmap_plugin.evaluation.metrics.psnr", "mipmap_plugin.models.load_model"}) == ["evaluation"]
    assert breaches("formats/ply.py", {"mipmap_plugin.models.base.SplatModel"}) == ["models"]
    assert breaches("models/mip.py", {"mipmap_plugin.models.base.SplatModel"}) == []


def circles(graph: dict[str, set[str]]) -> list[list[str]]:
    """The sets of more than one module that all reach each other (Tarjan 1972)."""
    index, low, stack, found = {}, {}, [], []

    def visit(node: str) -> None:
        index[node] = low[node] = len(index)
        stack.append(node)
        for other in sorted(graph.get(node, ())):
            if other not in index:
                visit(other)
                low[node] = min(low[node], low[other])
            elif other in stack:
                low[node] = min(low[node], index[other])
        if low[node] == index[node]:
            place = stack.index(node)
            if len(stack) - place > 1:
                found.append(sorted(stack[place:]))
            del stack[place:]

    for node in graph:
        if node not in index:
            visit(node)
    return found


def test_no_files_import_each_other_in_a_circle():
    """Imports inside functions and for types count too."""
    dotted = {".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__"): path for path in MODULES}
    graph = {
        name: {full if full in dotted else full.rpartition(".")[0] for full in imports(path) if full.startswith("mipmap_plugin")} - {name}
        for name, path in dotted.items()
    }
    assert circles(graph) == []


def test_no_benchmarks_import_each_other_in_a_circle():
    """They do so by bare names, as scripts."""
    scripts = {path.stem: path for path in (PACKAGE.parent / "benchmarks").glob("*.py")}
    assert circles({name: {full.split(".")[0] for full in imports(path)} & scripts.keys() for name, path in scripts.items()}) == []


def test_a_circle_would_be_found():
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"b"}, "d": {"a"}}) == [["b", "c"]]


def test_outside_libraries_stay_in_their_modules():
    def strays(path: Path) -> list[str]:
        outside = {name.split(".")[0] for name in imports(path)} - sys.stdlib_module_names - {"mipmap_plugin", "torch"}
        return sorted(library for library in outside if not name_of(path).startswith(tuple(CONFINED.get(library, []))))

    assert offenders(strays) == {}


def test_importing_what_every_command_needs_loads_nothing_optional():
    """The package, its backends, and what `inspect` compares viewers with."""
    optional = ["numba", "llvmlite", "gsplat", "triton", "matplotlib", "pycolmap", "pytest", "skimage", "tyro"]
    optional += ["dask", "distributed", "spandrel", "safetensors", "lpips", "torchvision", "viser"]
    modules = [f"mipmap_plugin.backends.{name}" for name in ("cpu", "gsplat", "inria", "triton")]
    modules.append("mipmap_plugin.evaluation.viewer_differences")
    code = f"import sys, {', '.join(modules)}; print([name for name in {optional} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=PACKAGE.parent, check=True)
    assert done.stdout.strip() == "[]"


def test_options_are_read_and_explained_without_torch():
    code = """
import contextlib, io, sys
from mipmap_plugin.cli import main
for options in (["--help"], ["adapt", "--help"], ["--version"]):
    with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):
        main(options)
print([name for name in ("torch", "numpy", "numba") if name in sys.modules])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=PACKAGE.parent, check=True)
    assert done.stdout.strip() == "[]"


def test_a_checkpoint_is_recognized_without_torch(tmp_path):
    """So that commands say at once what they were given, or what is wrong with it."""
    ply = tiny.ply(tmp_path / "a.ply")
    code = f"""
import sys
from mipmap_plugin.models import detect
print(detect({str(ply)!r}).family, [name for name in ("torch", "numba") if name in sys.modules])
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "3dgs []"
    assert isinstance(load_model(ply).traits, Traits)  # which is imported when it is first used


def test_files_and_functions_stay_small():
    def large(path: Path) -> list[str]:
        functions = [node for node in nodes(path) if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef))]
        sizes = [(node.name, node.end_lineno - node.lineno + 1, MAX_FUNCTION) for node in functions]
        sizes.append(("the file", len(path.read_text(encoding="utf-8").splitlines()), MAX_FILE))
        return [f"{name}: {lines}" for name, lines, most in sizes if lines > most]

    assert offenders(large) == {}


def test_functions_have_few_arguments():
    def with_many(path: Path) -> list[str]:
        found = []
        for node in nodes(path):
            if isinstance(node, ast.FunctionDef) and not f"{name_of(path)}: {node.name}".startswith(MANY_ARGUMENTS):
                names = [each.arg for each in (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs) if each.arg not in ("self", "cls")]
                found += [f"{node.name}: {len(names)}"] if len(names) > MAX_ARGUMENTS else []
        return found

    assert offenders(with_many) == {}


def test_the_library_neither_prints_nor_evaluates_text():
    def forbidden(path: Path) -> list[str]:
        names = {"eval", "exec"} if room(name_of(path)) in {"cli", "commands"} else {"eval", "exec", "print"}
        called = {node.func.id for node in nodes(path) if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)}
        return sorted(names & called)

    assert offenders(forbidden) == {}


def test_one_sentence_says_how_to_install_an_extra():
    """It is right in a clone too, from which the README installs."""
    told = re.compile(r"""pip install ["'](mipmap-plugin|\.)\[""")
    assert [name_of(path) for path in MODULES if told.search(path.read_text(encoding="utf-8"))] == ["errors.py"]


def test_text_is_read_and_written_in_an_encoding_that_is_named():
    """Windows would take its own."""

    def unnamed(path: Path) -> list[str]:
        calls = [node for node in nodes(path) if isinstance(node, ast.Call) and not {word.arg for word in node.keywords} & {"encoding", None}]
        of_text = [call for call in calls if ast.unparse(call.func).endswith((".read_text", ".write_text"))]
        return [ast.unparse(call) for call in (*of_text, *(call for call in calls if any(word.arg == "text" for word in call.keywords)))]

    assert offenders(unnamed) == {}


def test_annotations_of_stable_names_can_be_evaluated():
    """By pydantic, jsonargparse, beartype and Sphinx: what is imported for type checkers alone is not there when they ask."""

    def is_ours(thing: object) -> bool:
        return callable(thing) and (getattr(thing, "__module__", None) or "").startswith(PACKAGE.name)

    modules = ["", ".models", ".models.base", ".splatting.viewers", ".recipes", ".config", ".backends.base", ".scenes"]
    named = [getattr(module, name) for module in [import_module(PACKAGE.name + name) for name in modules] for name in dir(module)]
    public = [thing for thing in named if is_ours(thing)]
    methods = [method for thing in public if isinstance(thing, type) for _, method in inspect.getmembers(thing, inspect.isfunction)]
    assert {mipmap_plugin.Wrapped.render, mipmap_plugin.wrap_model} <= {*public, *methods}
    for thing in [*public, *filter(is_ours, methods)]:
        get_type_hints(thing)
    for function in (mipmap_plugin.wrap_model, mipmap_plugin.Wrapped.render, mipmap_plugin.Wrapped.adapt):
        validate_call(function, config={"arbitrary_types_allowed": True})
