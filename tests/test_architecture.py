"""The house's own rules, read from the source: what may import what, and how large a thing may grow."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "mipmap_plugin"
MODULES = sorted(PACKAGE.rglob("*.py"))

# From the ground up; a module imports only what lies below its own storey, or in its own package.
STOREYS = [
    {"errors"},
    {"staging", "limits"},
    {"registry", "config", "files", "torchvision_absent"},
    {"gaussians", "camera"},
    {"effects"},
    {"viewers"},
    {"backends", "models", "scenes"},
    {"recipes"},
    {"adaptation"},
    {"wrap"},
    {"evaluation", "models.conformance"},
    {"demo"},
    {"commands"},
    {"cli"},
]

# Where each outside library may be imported; torch and the standard library may be anywhere.
CONFINED = {
    "PIL": ["scenes/images.py"],
    "gsplat": ["backends/gsplat"],
    "llvmlite": ["backends/cpu_kernels/"],
    "lpips": ["evaluation/perceptual.py"],
    "matplotlib": ["evaluation/tradeoff_plot.py"],
    "numba": ["backends/cpu_kernels/"],
    "numpy": ["backends/", "evaluation/metrics.py", "models/", "scenes/images.py"],
    "plyfile": ["models/ply.py"],
    "pycolmap": ["scenes/"],
    "pydantic": ["config.py", "recipes.py", "adaptation/curve.py", "adaptation/report.py"],
    "pytest": ["backends/conformance/suite.py", "models/conformance.py"],
    "safetensors": ["adaptation/super_resolution.py"],
    "skimage": ["evaluation/metrics.py"],
    "spandrel": ["adaptation/super_resolution.py"],
    "tqdm": ["adaptation/detail.py", "adaptation/loop.py", "evaluation/backends.py", "evaluation/tradeoff.py", "evaluation/evaluate.py"],
    "triton": ["backends/triton"],
    "tyro": ["cli.py", "commands/"],
}

MAX_FILE, MAX_FUNCTION = 300, 60  # lines


def name_of(path: Path) -> str:
    return path.relative_to(PACKAGE).as_posix()


def imports(path: Path) -> set[str]:
    """The full names of the modules that a file imports, at its top or inside its functions."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: imports are absolute"
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
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


@pytest.mark.parametrize("path", [path for path in MODULES if path != PACKAGE / "__init__.py"], ids=name_of)
def test_imports_lead_downwards(path):
    assert breaches(name_of(path), imports(path)) == []


def test_a_breach_would_be_found():
    assert breaches("scenes/base.py", {"mipmap_plugin.models.base.SplatModel", "mipmap_plugin.camera.Camera"}) == ["models"]
    assert breaches("wrap.py", {"mipmap_plugin.evaluation.metrics.psnr", "mipmap_plugin.models.load_model"}) == ["evaluation"]
    assert breaches("models/ply.py", {"mipmap_plugin.models.base.SplatModel"}) == []


@pytest.mark.parametrize("path", MODULES, ids=name_of)
def test_outside_libraries_stay_in_their_modules(path):
    outside = {name.split(".")[0] for name in imports(path)} - sys.stdlib_module_names - {"mipmap_plugin", "torch"}
    for library in outside:
        assert any(name_of(path).startswith(place) for place in CONFINED.get(library, [])), f"{library} in {name_of(path)}"


def test_importing_the_package_loads_nothing_optional():
    optional = ["numba", "llvmlite", "gsplat", "triton", "matplotlib", "pycolmap", "pytest", "skimage", "tyro"]
    optional += ["spandrel", "safetensors", "lpips", "torchvision"]
    code = f"import sys, mipmap_plugin; print([name for name in {optional} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=PACKAGE.parent, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("path", MODULES, ids=name_of)
def test_files_and_functions_stay_small(path):
    text = path.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= MAX_FILE
    functions = [node for node in ast.walk(ast.parse(text)) if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef))]
    assert [f"{f.name}: {f.end_lineno - f.lineno + 1}" for f in functions if f.end_lineno - f.lineno + 1 > MAX_FUNCTION] == []


@pytest.mark.parametrize("path", MODULES, ids=name_of)
def test_the_library_neither_prints_nor_evaluates_text(path):
    calls = [node.func for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if isinstance(node, ast.Call)]
    forbidden = {"eval", "exec"} if room(name_of(path)) in {"cli", "commands"} else {"eval", "exec", "print"}
    assert forbidden.isdisjoint(call.id for call in calls if isinstance(call, ast.Name))
