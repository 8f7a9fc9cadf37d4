"""Families that break their contract: a sentence names them, the base stays as it was, and nothing wrong passes for a result."""

from dataclasses import replace

import pytest
import tiny
import torch
from their_families import BRIEF, Theirs, model, wrapped

from mipmap_plugin import load_model, register_model, wrap_model
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.errors import OutputExists, PluginError
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.models import API_VERSION, CERTAIN, Family, Match, Traits
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.plugin_errors import naming_any
from mipmap_plugin.splatting.rotations import rotations


def with_nan(method):
    """A method of a family that leaves a NaN."""

    def failing(self, *arguments):
        getattr(VanillaModel, method)(self, *arguments)
        with torch.no_grad():
            self.parameters()["scales"][3] = torch.nan

    return {method: failing}


def moving_itself(self, camera=None):
    with torch.no_grad():
        self.parameters()["means"].add_(0.01)
    return VanillaModel.gaussians(self, camera)


def raw_scales(self, camera=None):
    return replace(VanillaModel.gaussians(self, camera), scales=self.parameters()["scales"])


def with_covariances(made):
    """A method of a family that makes covariances of their factors."""

    def gaussians(self, camera=None):
        splats = VanillaModel.gaussians(self, camera)
        return replace(splats, covariances=made(rotations(splats.quats) * splats.scales[:, None, :]))

    return gaussians


@pytest.mark.parametrize(
    ("gaussians", "said"),
    [
        (lambda self, camera=None: {}["level"], "family 'theirs' failed: KeyError: 'level'"),
        (lambda self, camera=None: None, r"family 'theirs': gaussians\(\) has to return Gaussians; it returned a NoneType"),
        (
            lambda self, camera=None: (splats := VanillaModel.gaussians(self, camera)) and replace(splats, means=splats.means * torch.nan),
            r"family 'theirs': gaussians\(\) returned NaN or infinity in means",
        ),
        (moving_itself, r"family 'theirs' changed its input in place \(means\)"),
        (raw_scales, r"family 'theirs': gaussians\(\) returned negative scales, which have to be lengths; activate them by exp"),
        (with_covariances(lambda factors: factors), r"returned covariances that are not symmetric; of a factor L give L @ L\.mT"),
        (with_covariances(lambda factors: -factors @ factors.mT), "returned covariances with negative variances on the diagonal; check"),
    ],
)
def test_what_a_family_does_wrong_is_told_by_its_name(gaussians, said):
    with pytest.raises(PluginError, match=said):
        base = wrapped(gaussians=gaussians)
        base.render(base.cameras[0])
    with pytest.raises(PluginError, match=said):
        wrapped(gaussians=gaussians).adapt(0.5, **BRIEF)


def test_what_a_family_does_wrong_to_a_small_scene_is_told_by_its_name():
    """Whose splats are looked at as it is wrapped."""
    small = model(gaussians=lambda self, camera=None: None)
    with torch.no_grad():
        small.parameters()["means"].mul_(0.01)
    with pytest.raises(PluginError, match=r"family 'theirs': gaussians\(\) has to return Gaussians; it returned a NoneType"):
        wrap_model(small)


def opaque(self, camera=None):
    splats = VanillaModel.gaussians(self, camera)
    return replace(splats, opacities=3 * splats.opacities)


def without_a_color(self, camera=None):
    splats = VanillaModel.gaussians(self, camera)
    return replace(splats, sh=splats.sh[1:])


def with_a_root_of_0(self, camera=None):
    splats = VanillaModel.gaussians(self, camera)
    return replace(splats, means=splats.means + (splats.means - splats.means.detach()).norm(dim=1, keepdim=True).sqrt())


def detached(self, camera=None):
    return VanillaModel.gaussians(self, camera).detach()


def frozen(self):
    return type(self)({name: tensor.detach().clone() for name, tensor in self.parameters().items()})


@pytest.mark.parametrize(
    ("methods", "said"),
    [
        (dict(copy=lambda self: self), r"family 'theirs': copy\(\) shares means, .*; clone the tensors"),
        (dict(copy=lambda self: type(self)(self.parameters())), r"family 'theirs': copy\(\) shares means, .*; clone the tensors"),
        (dict(copy=frozen), r"family 'theirs': copy\(\) has to return parameters that are leaves and require gradients; means, .* cannot"),
        (dict(gaussians=detached), r"family 'theirs': gaussians\(\) returned splats without gradients"),
        (dict(copy=lambda self: None), r"family 'theirs': copy\(\) returned a NoneType, which lacks traits, "),
        (dict(gaussians=without_a_color), r"'theirs': gaussians\(\) returned splats that do not fit together: sh: expected .* got \[59, 4, 3\]"),
        (dict(gaussians=with_a_root_of_0), r"family 'theirs': gaussians\(\) has gradients with NaN or infinity in means;"),
        (dict(gaussians=opaque), r"family 'theirs': gaussians\(\) returned opacities from 1\.03 to 2\.84, which have to lie in 0\.\.1"),
        (with_nan("reshape"), r"family 'theirs': reshape\(form, views\) left NaN in scales; keep what it divides by"),
        (with_nan("rebuild"), r"family 'theirs': rebuild\(form\) left NaN in scales"),
        (dict(row_opacities=lambda self, views=(): torch.ones(3)), r"row_opacities\(\) has to return 60 finite num.*; it returned a tensor \[3\]"),
        (dict(row_opacities=lambda self, views=(): torch.full((60,), torch.nan)), r"row_opacities\(\) .* returned a tensor \[60\], not all finite"),
        (dict(rebuild=lambda self, form: None), r"rebuild\(form\) has to hold the splats that `form` returns; it called it 0 times"),
        (dict(rebuild=lambda self, form: form(self.gaussians()) and None), r"rebuild\(form\) .*; it holds 60 splats after it returned \d+"),
        (dict(row_opacities=lambda self, views=(): None), r"row_opacities\(\) has to return 60 finite numbers.*; it returned a NoneType"),
        (dict(__module__="__main__", rebuild=lambda self, form: {}["zz"]), "family 'theirs' failed: KeyError: 'zz'"),  # of a script; a copy's method
    ],
)
def test_a_family_that_breaks_its_contract_is_told_before_the_base_changes(methods, said):
    raw = {name: tensor.clone().requires_grad_() for name, tensor in tiny.model().parameters().items()}
    model = type("Odd", (Theirs,), methods)(raw)
    before = {name: tensor.detach().clone() for name, tensor in model.parameters().items()}
    with pytest.raises(PluginError, match=said):
        wrap_model(model, cameras=tiny.cameras(2), backend="reference").adapt(0.5, steps=3, extra_views=2, validation_views=2)
    assert all(torch.equal(before[name], tensor) for name, tensor in model.parameters().items())


def test_splats_without_gradients_may_be_adapted_without_steps():
    assert wrapped(gaussians=detached).adapt(0.5, recipe="instant", merge_to=1.0).report.gaussians_after == 60


def without_room(self, path, *, overwrite, networks_move=False):
    return {}["room"]


def test_a_family_that_fails_before_the_work_begins_is_told_by_its_name(tmp_path):
    with pytest.raises(PluginError, match="family 'theirs' failed: KeyError: 'room'"):
        wrapped(refuse_output=without_room).refuse_output(tmp_path / "new.ply", overwrite=False)


def test_a_family_that_fails_where_views_are_looked_through_is_told_by_its_name():
    with pytest.raises(PluginError, match="family 'theirs' failed: KeyError: 'rows'"):
        wrapped(row_opacities=lambda self, views=(): {}["rows"]).refuse_undrawn()


def with_copies(self, parameters):
    VanillaModel.replace_parameters(self, {name: tensor.detach().clone() for name, tensor in parameters.items()})


@pytest.mark.parametrize("replacing", [with_copies, lambda self, parameters: None])
def test_a_family_that_takes_other_tensors_than_an_optimizer_moves_is_told(replacing):
    with pytest.raises(PluginError, match=r"'theirs': replace_parameters\(\) has to keep the tensors themselves; means, .* are others then"):
        wrapped(replace_parameters=replacing).adapt(0.5, **BRIEF | dict(steps=3), prune_every=1, min_opacity=0.6)


class Leaving(Theirs):
    """Of its splats, which move, every other one leaves."""

    def __init__(self, *args):
        super().__init__(*args)
        self.traits = Traits(moves=True)

    def gaussians(self, camera=None):
        return super().gaussians(camera)[::2]


def test_splats_that_move_and_are_not_those_of_the_rows_are_told():
    said = r"'theirs': gaussians\(\) returned 30 splats for 60 rows of its parameters; return one for each, or say by the trait `rows`"
    with pytest.raises(PluginError, match=said):
        wrap_model(Leaving(tiny.model().parameters()), cameras=tiny.cameras(2), backend="reference").adapt(0.5, **BRIEF)


def half_doubles(self, form, views=()):
    raw = {name: tensor.detach() for name, tensor in self.parameters().items()}
    Gaussians(raw["means"].double(), raw["quats"], raw["scales"], raw["opacities"], raw["sh0"])


def test_shapes_that_a_family_mixes_up_are_told_by_its_name():
    with pytest.raises(PluginError, match="family 'theirs' failed: ShapeError: quats: "):
        wrapped(reshape=half_doubles).adapt(0.5, recipe="instant")


def test_a_family_that_does_not_say_what_it_wrote_is_told(tmp_path):
    def save(self, path, *, provenance, overwrite=False):
        VanillaModel.save(self, path, provenance=provenance, overwrite=overwrite)

    with pytest.raises(PluginError, match=r"family 'theirs': save\(\) has to return the path .* returned a NoneType, so that .*new\.ply is left"):
        wrapped(save=save).adapt(0.5, recipe="instant").save(tmp_path / "new.ply")


def test_a_family_that_ignores_what_is_there_replaces_nothing(tmp_path):
    def save(self, path, *, provenance, overwrite=False):
        return VanillaModel.save(self, path, provenance=provenance, overwrite=True)

    adapted = wrapped(save=save).adapt(0.5, recipe="instant")
    (tmp_path / "new.ply").write_text("precious")
    with pytest.raises(OutputExists):
        adapted.save(tmp_path / "new.ply")
    assert (tmp_path / "new.ply").read_text() == "precious"


def test_an_error_of_this_package_stays_what_it_is():
    with pytest.raises(ZeroDivisionError), naming_any({"backend 'odd'": ReferenceBackend()}):
        1 / 0  # noqa: B018


@pytest.mark.parametrize(("loaded", "said"), [(None, "a NoneType"), (tiny.gaussians(4), "a Gaussians"), ({"means": torch.zeros(3, 3)}, "a dict")])
def test_a_loader_that_returns_no_model_is_told_what_to_return(tmp_path, loaded, said):
    register_model("theirs", Family("theirs", "Theirs", lambda files: Match(CERTAIN, "all"), API_VERSION, lambda path, *, iteration=None: loaded))
    with pytest.raises(PluginError, match=f"family 'theirs': its load has to return an object with .*; it returned {said}$"):
        load_model(tiny.ply(tmp_path / "a.ply"))
