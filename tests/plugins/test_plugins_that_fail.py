"""Upsamplers, recipes and packages that break their contract: a sentence names them, and nothing wrong passes for a result."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from their_families import wrapped

from mipmap_plugin import register_recipe, register_upsampler
from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.errors import PluginError
from mipmap_plugin.recipes import RECIPES, default, recipe


@pytest.mark.parametrize(
    ("made", "said"),
    [
        (lambda image, size: 255 * resize(image, size, "lanczos"), "whose colors are 0..1; those that it returned are"),
        (lambda image, size: (255 * resize(image, size, "lanczos")).byte(), "in torch.uint8"),
        (lambda image, size: resize(image, size, "lanczos").to("meta"), "on cpu, where it got one; it returned one on meta"),
        (lambda image, size: sys.exit(0), "upsampler 'odd' failed: SystemExit"),
        (lambda image, size: 1 / 0, "failed: ZeroDivisionError"),
        (lambda image, size: None, "returned a NoneType"),
        (lambda image, size: image, r"returned \[24, 32, 3\] in torch.float32"),
        (lambda image, size: resize(image, size, "lanczos") * float("nan"), "not all finite"),
    ],
)
def test_an_upsampler_that_breaks_its_contract_is_told(made, said):
    register_upsampler("odd", made)
    with pytest.raises(PluginError, match=said):
        wrapped().adapt(2, recipe="paper", upsampler="odd", steps=1)


def test_an_upsampler_has_a_copy_of_the_image():
    def dims(image, size):
        return resize(image.mul_(0.5) / 0.5, size, "lanczos")

    register_upsampler("odd", dims)
    odd, plain = (wrapped().adapt(2, recipe="paper", upsampler=name, steps=2).report.curve[-1].psnr_db for name in ("odd", "lanczos"))
    assert odd == pytest.approx(plain, abs=1e-3)


@pytest.mark.parametrize("scale", [0.5, 2])
@pytest.mark.parametrize("name", ["default", "thorough", "paper"])
def test_a_recipe_made_from_another_leaves_that_as_it_is(name, scale):
    made = RECIPES.get(name)
    before = made(scale, False)
    made(scale, False)["steps"] = 3
    assert made(scale, False) == before and default(scale, True)["steps"] != 3


def test_a_recipe_that_ends_the_process_is_told_by_name():
    register_recipe("mine", lambda scale, network: sys.exit(0))
    with pytest.raises(PluginError, match=r"recipe 'mine' failed at x0\.5: SystemExit: 0"):
        recipe("mine", 0.5)


@pytest.mark.parametrize(("made", "said"), [([("steps", 3)], "a list"), ({3: "steps"}, "other keys than texts")])
def test_a_recipe_that_returns_no_settings_by_name_is_told(made, said):
    register_recipe("mine", lambda scale, network: made)
    with pytest.raises(PluginError, match=rf"recipe 'mine' has to return a dict of settings by name; at x0\.5 it returned {said}$"):
        recipe("mine", 0.5)


@pytest.mark.parametrize(("text", "code"), [
    (b"[any]\nmine\n", "import mipmap_plugin; mipmap_plugin.register_recipe"),
    (b"\xff\xfe[any]\n", "from mipmap_plugin.__main__ import run; exit(run())"),
])  # fmt: skip
def test_a_package_whose_entry_points_cannot_be_read_is_named(tmp_path, text, code):
    """Which nothing that reads entry points survives, pydantic among them."""
    folder = tmp_path / "stranger-1.0.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: stranger\nVersion: 1.0\n")
    (folder / "entry_points.txt").write_bytes(text)
    paths = os.pathsep.join([*filter(None, [os.environ.get("PYTHONPATH")]), str(Path(__file__).parents[2]), str(tmp_path)])
    ended = subprocess.run([sys.executable, "-c", code, "list"], env={**os.environ, "PYTHONPATH": paths}, capture_output=True, text=True)
    assert "the entry points of the installed package stranger 1.0 cannot be read" in ended.stderr.splitlines()[-1], ended.stderr
