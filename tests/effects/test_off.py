"""An effect that is off is not computed, not imported and not in the gradient graph; forced on, it gives the same image."""

import subprocess
import sys
from dataclasses import replace

import moving
import pytest
import tiny
import torch
from tiny import with_bands, wrapped

from mipmap_plugin import register_upsampler
from mipmap_plugin.adaptation.optimization import density
from mipmap_plugin.adaptation.renderers import Renderer
from mipmap_plugin.backends import reference, supersample
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.effects import Effects
from mipmap_plugin.errors import PluginError
from mipmap_plugin.models.moving.deformable import DeformNetwork
from mipmap_plugin.models.moving.hexplane import HexPlane
from mipmap_plugin.splatting import filters, harmonics
from mipmap_plugin.wrap import wrap_model

pytestmark = pytest.mark.usefixtures("few_views")

BRIEF = dict(steps=2, extra_views=0)


def counted(monkeypatch, owner, name) -> list:
    """The arguments of each call of `owner.name` from now on."""
    calls, real = [], getattr(owner, name)
    monkeypatch.setattr(owner, name, lambda *args, **named: calls.append(args) or real(*args, **named))
    return calls


def leaves_of(image: torch.Tensor) -> list[torch.Tensor]:
    """The leaf tensors that an image's gradient graph reaches."""
    seen, left, leaves = set(), [image.grad_fn], []
    while left:
        node = left.pop()
        if node is None or node in seen:
            continue
        seen.add(node)
        if hasattr(node, "variable"):
            leaves.append(node.variable)
        left += [following for following, _ in node.next_functions]
    return leaves


# View-dependent color


@pytest.mark.parametrize("used", [0, 1, 2, 3])
def test_bands_above_the_last_nonzero_one_are_not_evaluated(monkeypatch, used):
    degrees = []
    monkeypatch.setattr(reference, "colors", lambda *arguments: degrees.append(arguments[-1]) or harmonics.colors(*arguments))
    splats = with_bands(used, 3)
    model = wrapped(splats)
    image = model.render(tiny.cameras(1)[0]).image
    assert degrees == [used]
    forced = reference.ReferenceBackend().render(splats, tiny.cameras(1)[0], Effects(3)).image
    torch.testing.assert_close(image, forced, atol=1e-6, rtol=0)


def test_bands_that_are_off_stay_off_while_adapting(monkeypatch):
    degrees = set()
    monkeypatch.setattr(reference, "colors", lambda *arguments: degrees.add(arguments[-1]) or harmonics.colors(*arguments))
    adapted = wrapped(with_bands(1, 3)).adapt(1 / 4, steps=2, extra_views=0)
    assert degrees == {0, 1}  # degree 0 for the blend weights, which are rendered in gray
    assert (adapted.model.parameters()["shN"][:, 3:] == 0).all()


def test_a_color_that_is_the_same_from_everywhere_needs_no_direction(monkeypatch):
    evaluated = counted(monkeypatch, harmonics, "basis")
    splats, camera = with_bands(0, 3), tiny.cameras(1)[0]
    image = wrapped(splats).render(camera).image
    assert evaluated == []
    torch.testing.assert_close(image, ReferenceBackend().render(splats, camera, Effects(3)).image, atol=1e-6, rtol=0)
    assert len(evaluated) == 1


def test_means_have_no_gradient_through_a_color_without_direction():
    means = torch.zeros(2, 3, requires_grad=True)
    sh = torch.ones(2, 16, 3, requires_grad=True)
    reached = [[leaf.shape for leaf in leaves_of(harmonics.colors(sh, means, torch.ones(3), degree))] for degree in (0, 1)]
    assert reached[0] == [sh.shape] and set(reached[1]) == {sh.shape, means.shape}


@pytest.mark.parametrize(("used", "moves"), [(0, False), (1, True)])
def test_unused_coefficients_are_not_in_the_gradient_graph(used, moves, monkeypatch):
    graphs = []
    monkeypatch.setattr(Renderer, "of_model", lambda self, model: lambda camera: self(model.gaussians(camera), camera))  # with gradients

    def look(step, seconds, show):
        image = show(tiny.cameras(1)[0].zoomed(1 / 4))
        graphs.append({leaf.data_ptr() for leaf in leaves_of(image)})

    splats = with_bands(used, 3)
    adapted = wrapped(splats).adapt(1 / 4, observe=look, steps=4, extra_views=0, prune_every=2, min_opacity=0.5, returns="last")
    unseen = adapted.model.parameters()["shN"]
    assert (unseen.data_ptr() in graphs[-1]) == moves
    assert 0 < len(unseen) < 10  # it stays out when splats are dropped
    assert unseen.requires_grad == moves and bool(unseen.any()) == moves


# Time


def zero_heads(state):
    """The weights of a field, with last layers of zeros."""
    heads = ("gaussian_warp", "branch_", "gaussian_rotation", "gaussian_scaling", "deform.3")
    return {name: torch.zeros_like(held) if any(head in name for head in heads) else held for name, held in state.items()}


FIELDS = {
    "deformable": (DeformNetwork, moving.write_deformable, lambda: moving.deform_state()),
    "6-DoF": (DeformNetwork, moving.write_deformable, lambda: moving.deform_state(six_dof=True)),
    "hexplane": (HexPlane, moving.write_hexplane, lambda: moving.hexplane_state()),
}


@pytest.mark.parametrize("family", FIELDS)
def test_a_field_that_changes_nothing_is_not_evaluated(tmp_path, monkeypatch, family):
    kind, write, state = FIELDS[family]
    model = wrap_model(write(tmp_path / "still", state=zero_heads(state())), cameras=tiny.cameras(2), backend="reference")
    evaluated = counted(monkeypatch, kind, "changes")
    image = model.render(moving.at(0.3)).image
    adapted = model.adapt(1 / 4, **BRIEF)
    assert evaluated == [] and "time" not in adapted.report.views
    assert [effect.on for effect in adapted.report.effects if effect.name == "time"] == [False]
    forced = ReferenceBackend().render(moving.moved_to(model.model.field, model.model.canonical, 0.3), moving.at(0.3), model.effects()).image
    assert len(evaluated) == 1
    torch.testing.assert_close(image, forced, atol=1e-5, rtol=0)


@pytest.mark.parametrize("family", FIELDS)
def test_a_field_that_changes_something_is_evaluated(tmp_path, monkeypatch, family):
    kind, write, state = FIELDS[family]
    model = wrap_model(write(tmp_path / "moving", state=state()), cameras=tiny.cameras(2), backend="reference")
    model.backend()  # which asks once what the model needs
    evaluated = counted(monkeypatch, kind, "changes")
    model.render(moving.at(0.3))
    assert len(evaluated) == 1


@pytest.mark.parametrize(("options", "moves"), [("", False), ("apply_rotation=True", True), ("static_mlp=True", True)])
def test_fields_that_multiply_count_as_moving(tmp_path, options, moves):
    model = wrap_model(moving.write_hexplane(tmp_path / "new", options, zero_heads(moving.hexplane_state())), cameras=tiny.cameras(1))
    assert model.model.moves == moves


def test_a_field_that_shifts_all_splats_alike_counts_as_moving(tmp_path):
    state = zero_heads(moving.hexplane_state())
    state["deformation_net.pos_deform.3.bias"] = torch.tensor([0.1, 0.0, 0.0])
    assert wrap_model(moving.write_hexplane(tmp_path / "new", "", state), cameras=tiny.cameras(1)).model.moves


def test_a_static_scene_evaluates_no_field(monkeypatch):
    evaluated = counted(monkeypatch, DeformNetwork, "changes"), counted(monkeypatch, HexPlane, "changes")
    assert "time" not in wrapped(with_bands(1, 1)).adapt(1 / 4, **BRIEF).report.views
    assert evaluated == ([], [])


# Filters and samples


def test_without_compensation_the_opacity_is_unchanged():
    splats = tiny.gaussians(3)
    flat = reference.project(splats, tiny.cameras(1)[0], 0.2)
    assert filters.footprint(flat, splats.opacities, "classic", 0.3).opacities is splats.opacities
    assert filters.footprint(flat, splats.opacities, "antialiased", 0.3).opacities is not splats.opacities
    wide = filters.footprint(flat, splats.opacities, "antialiased", 0.0).opacities  # forced on where nothing is widened
    torch.testing.assert_close(wide, splats.opacities, atol=1e-6, rtol=0)


def test_without_supersampling_the_backend_draws_once_at_the_size_of_the_image(monkeypatch):
    drawn = counted(monkeypatch, ReferenceBackend, "render")
    view = tiny.cameras(1)[0]
    model = wrapped(with_bands(1, 1))
    image = model.render(view).image
    assert [args[2] for args in drawn] == [view]
    forced = supersample.render(ReferenceBackend(), model.model.gaussians(view), view, replace(model.effects(), supersampling=1))
    assert torch.equal(image, forced.image)
    model.render(view, supersampling=2)
    assert (drawn[-1][2].width, len(drawn)) == (2 * view.width, 3)


def test_at_scale_one_nothing_is_drawn(monkeypatch):
    drawn = counted(monkeypatch, ReferenceBackend, "render")
    wrapped(with_bands(1, 1)).adapt(1)
    assert drawn == []


# Adapting


@pytest.mark.parametrize(("settings", "steps"), [({}, 0), (dict(densify_gradient=1e-9), 2)])
def test_screen_gradients_are_kept_only_where_something_is_densified(monkeypatch, settings, steps):
    created, added = counted(monkeypatch, density.ScreenGradients, "__init__"), counted(monkeypatch, density.ScreenGradients, "add")
    model = wrapped(with_bands(1, 1))
    adapted = model.adapt(1 / 4, views_per_step=1, **BRIEF, **settings)
    assert (len(created), len(added)) == (bool(steps), steps)
    forced = model.adapt(1 / 4, views_per_step=1, **BRIEF, densify_gradient=1e9)  # kept, and never used
    names = adapted.model.parameters()
    assert steps or all(torch.equal(tensor, names[name]) for name, tensor in forced.model.parameters().items())


@pytest.fixture
def broken_upsampler():
    """One that cannot be imported; known while the test lasts."""
    register_upsampler("broken", "no_such_package.upsampling:enlarge")
    return "broken"


@pytest.mark.parametrize(("scale", "settings"), [(1 / 4, {}), (4, dict(compare_at="base")), (4, dict(compare_at="target", steps=0))])
def test_an_upsampler_that_is_not_called_for_is_not_imported(broken_upsampler, scale, settings):
    wrapped(with_bands(1, 1)).adapt(scale, upsampler=broken_upsampler, **{**BRIEF, **settings})


def test_an_upsampler_that_is_called_for_is_imported(broken_upsampler):
    with pytest.raises(PluginError, match="no_such_package"):
        wrapped(with_bands(1, 1)).adapt(4, upsampler=broken_upsampler, compare_at="target", **BRIEF)


@pytest.mark.parametrize(("scale", "settings"), [(1 / 2, {}), (2, dict(upsampler="bicubic", compare_at="both"))])
def test_steps_by_autograd_load_no_compiler(monkeypatch, scale, settings):
    """As gradients that are given to torch do, which takes the time of many steps."""
    monkeypatch.setitem(sys.modules, "torch.fx.experimental.symbolic_shapes", None)
    assert wrapped(with_bands(1, 1)).adapt(scale, **BRIEF, **settings).report.curve[-1].step == 2


# Prints, a line each, which modules were imported: by adapting, by rendering an image, and by rendering its depth too.
IMPORTED = """
import sys
import torch  # which imports parts of its compilers itself before 2.6
before = set(sys.modules)
from mipmap_plugin import wrap_model
def tell():
    print(*sorted(name for name in sys.argv[3:] if name in set(sys.modules) - before))
model = wrap_model(sys.argv[1], backend=sys.argv[2])
for scale in (1 / 4, 2):
    adapted = model.adapt(scale, steps=2, extra_views=2)
    adapted.render(model.cameras[0].zoomed(scale))
    adapted.save(f"{sys.argv[1]}_{scale}")
tell()
model = wrap_model(sys.argv[1], backend="reference")
for outputs in ([], ["depth"]):
    model.render(model.cameras[0], outputs=outputs)
    tell()
"""

OUTPUTS = "mipmap_plugin.backends.geometry"
OPTIONAL = [OUTPUTS, "torch._dynamo", "torch._inductor", "sympy"]
OPTIONAL += ["gsplat", "llvmlite", "lpips", "matplotlib", "numba", "pycolmap", "pytest", "skimage", "spandrel", "torchvision", "triton", "tyro"]


@pytest.fixture(scope="module", params=[pytest.param("reference", marks=pytest.mark.slow), "cpu"])
def imported(request, tmp_path_factory):
    """The lines of `IMPORTED`, by words: one process for all that is asked of it."""
    pytest.importorskip("numba")
    folder = tiny.folder(tmp_path_factory.mktemp("imported") / "base")
    done = subprocess.run([sys.executable, "-c", IMPORTED, str(folder), request.param, *OPTIONAL], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return [line.split() for line in done.stdout.splitlines()]


def test_adapting_imports_nothing_that_it_does_not_use(imported):
    """What comes before the first step has kernels, whatever the backend; torch compiles nothing."""
    assert imported[0] == ["llvmlite", "numba"]


def test_code_for_outputs_is_imported_only_for_them(imported):
    assert [OUTPUTS in words for words in imported[1:]] == [False, True]
