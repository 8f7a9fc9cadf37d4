"""Backends that break their contract: a sentence names them, and nothing wrong passes for a result."""

import copy
import sys

import pytest
import tiny
import torch
from their_families import BRIEF

from mipmap_plugin import register_backend, wrap_model
from mipmap_plugin.backends.base import AdamStep, Rendered
from mipmap_plugin.backends.conformance import CASES, check_backend, summary
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.cli import main
from mipmap_plugin.errors import PluginError


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
        (lambda rendered, _: rendered.image, r"backend 'odd' has to return a Rendered with an image \[\d+, \d+, 3\]; it returned a Tensor"),
        (lambda rendered, _: rendered.replaced(image=rendered.image.detach().numpy()), r"with an image \[\d+, \d+, 3\]; it returned a ndarray"),
        (lambda rendered, _: rendered.replaced(image=rendered.image.movedim(2, 0)), r"with an image \[.*, 3\]; it returned an image \[3,"),
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
        ("stepper", lambda self, raw: None, "stepper has to return a Stepper; a NoneType, which it returned, lacks render, differentiate, step"),
        ("compile_ahead", lambda self, *_: 1 / 0, "failed: ZeroDivisionError"),
    ],
)
def test_what_a_backend_may_have_is_looked_at_too(part, method, said):
    base = backend(lambda rendered, _: rendered, **{part: method})
    with pytest.raises(PluginError, match=f"backend 'odd'.*{said}"):
        base.adapt(0.5, **BRIEF, views_per_step=4, warm_up=0)


def test_a_backend_that_does_not_list_what_it_lacks_is_told():
    base = backend(lambda rendered, _: rendered, lacking=lambda self, needs: "no")
    with pytest.raises(PluginError, match=r"backend 'odd': lacking\(\) has to return a list of sentences; it returned a str"):
        base.render(base.cameras[0])


class Idle:
    """A stepper that does nothing."""

    def render(self, number, camera, effects):
        pass

    def differentiate(self, number, d_image, d_alpha=None):
        pass

    def step(self, step):
        pass


def test_a_stepper_that_draws_all_views_in_one_call_still_does_and_fails_by_its_backends_name():
    class Failing(Idle):
        def render_all(self, shots):
            return 1 / 0

        def differentiate_all(self, gradients):
            pass

    base = backend(lambda rendered, _: rendered, stepper=lambda self, raw: Failing())
    with pytest.raises(PluginError, match="backend 'odd' failed: ZeroDivisionError"):
        base.backend()[0].stepper({}).render_all([])


def test_a_stepper_that_writes_no_gradient_for_growing_is_told():
    raw = {"means": torch.zeros(2, 3)}
    base = backend(lambda rendered, _: rendered, stepper=lambda self, raw: Idle())
    with pytest.raises(PluginError, match="backend 'odd': a step left NaN or infinity in the gradient of the means"):
        base.backend()[0].stepper(raw).step(AdamStep(raw, {}, {}, {}, (0.9, 0.99), 1.0, 1.0, means_gradient=torch.zeros(2, 3)))


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
