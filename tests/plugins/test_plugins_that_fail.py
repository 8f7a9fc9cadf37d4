"""Plug-ins that break their contract: a sentence names them, the base stays as it was, and nothing wrong passes for a result."""

import copy
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import tiny
import torch

from mipmap_plugin import register_backend, register_recipe, register_upsampler, register_viewer, wrap_model
from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.backends.base import Rendered
from mipmap_plugin.backends.conformance import CASES, check_backend, summary
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.cli import main
from mipmap_plugin.errors import PluginError, SettingsError
from mipmap_plugin.recipes import default
from mipmap_plugin.render_settings import EvenBuckets, Packing, RenderSettings
from mipmap_plugin.splatting.viewers import Viewer, single_viewers


def backend(render, **parts):
    """A backend that draws as the reference, but for `render(rendered, gaussians)`."""

    def changed(self, gaussians, camera, effects):
        return render(ReferenceBackend.render(self, gaussians, camera, effects), gaussians)

    register_backend("odd", type("Odd", (ReferenceBackend,), {"name": "odd", "render": changed, **parts}))
    return wrap_model(tiny.model(), cameras=tiny.cameras(2), backend="odd")


class Broken(torch.autograd.Function):
    """An image whose gradient is not finite."""

    @staticmethod
    def forward(ctx, image):
        return image.clone()

    @staticmethod
    def backward(ctx, gradient):
        return gradient * torch.nan


def in_place(rendered, gaussians):
    with torch.no_grad():
        gaussians.means.add_(0.01)
    return rendered


BRIEF = dict(steps=1, extra_views=2, validation_views=2, merge_to=1.0)


def test_a_backend_by_itself_may_draw_in_inference_mode():
    odd = backend(lambda rendered, _: rendered)
    with torch.inference_mode():
        rendered = odd.backend()[0].render(tiny.gaussians(), odd.cameras[0], odd.effects())
    assert torch.allclose(rendered.image, odd.render(odd.cameras[0]).image, atol=1e-4)


@pytest.mark.parametrize(
    ("render", "said"),
    [
        (lambda rendered, _: 1 / 0, "backend 'odd' failed: ZeroDivisionError: division by zero"),
        (lambda rendered, _: sys.exit(0), "backend 'odd' failed: SystemExit: 0"),
        (lambda rendered, _: rendered.replaced(image=rendered.image * torch.nan), "backend 'odd' returned an image with NaN or infinity"),
        (lambda rendered, _: rendered.replaced(image=rendered.image.double()), "images of the splats' type torch.float32; it returned torch.float64"),
        (lambda rendered, _: rendered.replaced(image=rendered.image.to("meta")), "images on the splats' device cpu; it returned one on meta"),
        (lambda rendered, _: rendered.replaced(image=255 * rendered.image), r"returned colors up to \d+, where .*; return 0..1, not 0..255"),
        (in_place, r"backend 'odd' changed its input in place \(means\)"),
    ],
)
def test_what_a_backend_draws_wrong_is_told_by_its_name(render, said):
    base = backend(render)
    with pytest.raises(PluginError, match=said):
        base.render(base.cameras[0])
    with pytest.raises(PluginError, match=said):
        base.adapt(0.5, **BRIEF)


@pytest.mark.parametrize(
    ("render", "said"),
    [
        (lambda rendered, _: rendered.replaced(image=Broken.apply(rendered.image)), "backend 'odd' returned gradients with NaN or infinity for"),
        (lambda rendered, _: rendered.replaced(image=rendered.image.detach()), "backend 'odd' returned an image without gradients"),
    ],
)
def test_wrong_gradients_of_a_backend_are_told_by_its_name(render, said):
    base = backend(render)
    base.adapt(2, recipe="instant", closed_form=False)  # which has no gradients
    with pytest.raises(PluginError, match=said):
        base.adapt(0.5, **BRIEF)


def by_splats(rendered, _):
    """As drawn by a loop over the splats in view: without gradients where there are none."""
    return rendered if (rendered.image != rendered.image[:1, :1]).any() else Rendered(rendered.image.detach(), rendered.alpha.detach())


def test_an_image_of_nothing_may_come_without_gradients():
    base = backend(by_splats)
    assert base.adapt(0.25, **(BRIEF | dict(merge_to=0.5))).report.curve  # which meets images of one pixel
    outcomes = check_backend(base.backend()[0].theirs, {name: CASES[name] for name in ("no-splat", "no-splat-in-view")})
    assert summary(outcomes) == "2 cases: 2 run, 0 skipped, 0 failed"


@pytest.mark.parametrize(
    ("alpha", "said"),
    [
        (None, r"\[48, 64\]; it returned a NoneType"),
        (torch.zeros(3, 3), r"\[48, 64\]; it returned \[3, 3\]"),
        (torch.zeros(48, 64, dtype=torch.float64), "in torch.float32 on cpu, as the image; it returned one in torch.float64 on cpu"),
        (torch.zeros(48, 64, device="meta"), "in torch.float32 on cpu, as the image; it returned one in torch.float32 on meta"),
    ],
)
def test_a_wrong_alpha_of_a_backend_is_told_by_its_name(alpha, said):
    base = backend(lambda rendered, _: Rendered(rendered.image, alpha))
    with pytest.raises(PluginError, match=f"backend 'odd' has to return an alpha {said}"):
        base.render(base.cameras[0], supersampling=2)


@pytest.mark.parametrize(
    ("part", "method", "said"),
    [
        ("render_views", lambda self, gaussians, shots: [], "render_views has to return a list of 1 Rendered, one for each view; it returned 0"),
        ("blend_weights", lambda self, *_: torch.zeros(3), "blend_weights has to return 60 finite numbers"),
        ("weigh_views", lambda self, *_: torch.zeros(3), r"weigh_views has to return finite numbers \[\d+, 60\]"),
        ("stepper", lambda self, raw: 1 / 0, "failed: ZeroDivisionError"),
        ("compile_ahead", lambda self, *_: 1 / 0, "failed: ZeroDivisionError"),
    ],
)
def test_what_a_backend_may_have_is_looked_at_too(part, method, said):
    base = backend(lambda rendered, _: rendered, **{part: method})
    with pytest.raises(PluginError, match=f"backend 'odd'.*{said}"):
        base.adapt(0.5, **BRIEF, views_per_step=4, warm_up=0)


def test_a_stepper_that_draws_all_views_in_one_call_still_does_and_fails_by_its_backends_name():
    class Failing:
        def render_all(self, shots):
            return 1 / 0

        def differentiate_all(self, gradients):
            pass

    base = backend(lambda rendered, _: rendered, stepper=lambda self, raw: Failing())
    with pytest.raises(PluginError, match="backend 'odd' failed: ZeroDivisionError"):
        base.backend()[0].stepper({}).render_all([])


def test_a_backend_that_fails_ends_a_command_in_a_sentence(tmp_path, capsys):
    backend(lambda rendered, _: 1 / 0)
    folder = tiny.folder(tmp_path / "base", tiny.cameras(3))
    assert main(["adapt", str(folder), "--scale", "1/2", "--backend", "odd", "--output", str(tmp_path / "new.ply")]) == 2
    assert capsys.readouterr().err.strip().endswith("mipmap-plugin: backend 'odd' failed: ZeroDivisionError: division by zero")
    assert not (tmp_path / "new.ply").exists()


def test_a_failing_backend_that_nobody_asked_for_says_how_to_take_another():
    backend(lambda rendered, _: 1 / 0, speed=99)
    base = wrap_model(tiny.model(), cameras=tiny.cameras(2))
    with pytest.raises(PluginError, match=r"backend 'odd' \(taken as the fastest; another is taken by --backend NAME, or backend=\) failed: Zero"):
        base.render(base.cameras[0])


def test_what_is_wrapped_with_a_backend_of_ones_own_can_be_copied():
    base = backend(lambda rendered, _: rendered)
    before = base.adapt(0.5, recipe="instant")
    copied = copy.deepcopy(base)
    assert torch.equal(copied.render(base.cameras[0]).image, base.render(base.cameras[0]).image) and before.backend.name == "odd"


@pytest.mark.parametrize(
    ("made", "said"),
    [
        (lambda image, size: 255 * resize(image, size, "lanczos"), "whose colors are 0..1; those that it returned are"),
        (lambda image, size: (255 * resize(image, size, "lanczos")).byte(), "in torch.uint8"),
        (lambda image, size: resize(image, size, "lanczos").to("meta"), "on cpu, where it got one; it returned one on meta"),
        (lambda image, size: sys.exit(0), "upsampler 'odd' failed: SystemExit"),
    ],
)
def test_an_upsampler_of_other_numbers_is_told(made, said):
    register_upsampler("odd", made)
    base = wrap_model(tiny.model(), cameras=tiny.cameras(2), backend="reference")
    with pytest.raises(PluginError, match=said):
        base.adapt(2, recipe="paper", upsampler="odd", steps=1)


def test_an_upsampler_has_a_copy_of_the_image():
    def dims(image, size):
        return resize(image.mul_(0.5) / 0.5, size, "lanczos")

    base = wrap_model(tiny.model(), cameras=tiny.cameras(2), backend="reference")
    register_upsampler("odd", dims)
    odd, plain = (base.adapt(2, recipe="paper", upsampler=name, steps=2).report.curve[-1].psnr_db for name in ("odd", "lanczos"))
    assert odd == pytest.approx(plain, abs=1e-3)


@pytest.mark.parametrize("scale", [0.5, 2])
@pytest.mark.parametrize("recipe", ["default", "thorough", "paper"])
def test_a_recipe_made_from_another_leaves_that_as_it_is(recipe, scale):
    from mipmap_plugin import recipes

    made = getattr(recipes, recipe)
    before = made(scale, False)
    made(scale, False)["steps"] = 3
    assert made(scale, False) == before and default(scale, True)["steps"] != 3


def test_a_recipe_may_be_made_from_another():
    register_recipe("mine", lambda scale, network: {**default(scale, network), "steps": 1})
    assert wrap_model(tiny.model(), cameras=tiny.cameras(2)).adapt(0.5, recipe="mine", extra_views=2).report.settings.steps == 1


def test_what_a_recipe_sets_wrong_is_told_by_its_name():
    register_recipe("mine", lambda scale, network: {"steps": -4})
    base = wrap_model(tiny.model(), cameras=tiny.cameras(2))
    with pytest.raises(SettingsError, match="recipe mine: setting steps: must be a whole number of at least 0, got -4"):
        base.adapt(0.5, recipe="mine")
    with pytest.raises(SettingsError, match=r"^setting steps: must be a whole number of at least 0, got -4"):
        base.adapt(0.5, steps=-4)


@pytest.mark.parametrize("name", ["", " ", "../kiosk", "our/kiosk", "x\ny", "-v", ".hidden"])
def test_names_are_parts_of_file_names(name):
    with pytest.raises(SettingsError, match=r"a name is a text of a line|a name begins with a letter"):
        register_viewer(name, Viewer("kiosk", "Kiosk", "ours", "classic", 0.3))


@pytest.mark.parametrize(
    "wrong",
    [
        {"min_alpha": 0.0}, {"min_alpha": 2.0}, {"min_alpha": "x"}, {"min_alpha": float("nan")}, {"min_transmittance": 2.0}, {"radius": 0},
        {"radius": -3.0}, {"tile": 0}, {"tile": 3.5}, {"tile": 100_000}, {"max_alpha": 0.0}, {"max_color": -1.0}, {"color_steps": (0.1, 0.1)},
        {"color_steps": [0.1, 0.1, 0.1]}, {"min_variance": -1.0}, {"max_half_axis": 0.0, "radius": 3.0}, {"frame": -1.0}, {"picture_step": -1.0},
        {"linear_light": 0.0}, {"packing": "yes"}, {"even_buckets": True},
    ],
)  # fmt: skip
def test_render_settings_out_of_range_are_refused(wrong):
    with pytest.raises(SettingsError, match=f"render settings: {next(iter(wrong))} must be"):
        RenderSettings(**wrong)


@pytest.mark.parametrize(("largest", "step"), [(1.0, 0.3), (4.0, 0.35), (0.5, 1.0)])
def test_steps_of_colors_that_pass_their_limit_are_refused(largest, step):
    with pytest.raises(SettingsError, match=f"max_color must be a multiple of each of color_steps, .* got {largest} and {step}"):
        RenderSettings(max_color=largest, color_steps=(largest / 4, step, step))


@pytest.mark.parametrize(
    "wrong",
    [{"opacity": (0.0,)}, {"color": 0.0}, {"bands": (0.0,)}, {"log_scales": (9.0, -12.0, 0.1)}, {"quats": "smallest"}, {"bands": [0.1]}],
)
def test_packings_out_of_range_are_refused(wrong):
    with pytest.raises(SettingsError, match=f"packing: {next(iter(wrong))} must be"):
        Packing(**wrong)


@pytest.mark.parametrize("wrong", [{"steps": 0}, {"steps": 2.5}, {"steps": 1 << 40}, {"sphere_from": float("nan")}])
def test_buckets_out_of_range_are_refused(wrong):
    with pytest.raises(SettingsError, match=f"even buckets: {next(iter(wrong))} must be"):
        EvenBuckets(**wrong)


@pytest.mark.parametrize(
    "wrong",
    [
        *({"near_plane": float("nan")}, {"near_plane": "0.2"}, {"near_plane": -5}, {"sh_degree": -1}, {"eps2d": True}, {"eps2d": 1e300}),
        *({"read_degrees": ()}, {"read_degrees": 3}, {"read_degrees": (0, [1])}, {"read_degrees": (5,)}),
    ],
)
def test_viewers_out_of_range_are_refused(wrong):
    values = {"eps2d": 0.3, **wrong}
    with pytest.raises(SettingsError, match=f"viewer 'kiosk': {next(iter(wrong))} must be"):
        Viewer("kiosk", "Kiosk", "ours", "classic", **values)


def test_numbers_of_numpy_are_numbers():
    assert RenderSettings(min_alpha=np.float64(0.01)).min_alpha == 0.01


def test_a_viewer_that_cannot_be_loaded_hides_no_other():
    register_viewer("missing", "nosuch:VIEWER")
    register_viewer("none", ())
    assert {"spark", "classic"} <= set(single_viewers()) and not {"missing", "none", "portable"} & set(single_viewers())


@pytest.mark.parametrize("cameras", [[], ()])
def test_an_empty_list_of_cameras_is_no_wish_for_an_orbit(cameras):
    with pytest.raises(SettingsError, match="cameras: there are none"):
        wrap_model(tiny.model(), cameras=tiny.cameras(2)).adapt(0.5, cameras=cameras)


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
