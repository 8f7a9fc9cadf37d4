"""What a family or a backend of a stranger breaks is told in a sentence that names it, most of it before any work."""

import sys
from dataclasses import replace
from pathlib import Path

import pytest
import tiny
import torch

from mipmap_plugin import load_model, register_backend, register_model, register_recipe, wrap_model
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.cli import main
from mipmap_plugin.errors import CheckpointError, PluginError, SettingsError
from mipmap_plugin.formats.atomic import new_file
from mipmap_plugin.models import API_VERSION, CERTAIN, Family, Match, TrainedScale, Traits
from mipmap_plugin.models.contract import lacking
from mipmap_plugin.models.vanilla import Origin, VanillaModel
from mipmap_plugin.splatting.rotations import rotations

BRIEF = dict(steps=1, extra_views=2, validation_views=2)


class Theirs(VanillaModel):
    family = "theirs"


def model(**members):
    return type("Odd", (Theirs,), members)(tiny.model().parameters())


def wrapped(**members):
    return wrap_model(model(**members), cameras=tiny.cameras(2))


def parameters(**changes):
    return lambda self: {**VanillaModel.parameters(self), **changes}


@pytest.mark.parametrize(
    ("members", "said"),
    [
        (dict(reshape=lambda self, form: None), r"lacks reshape\(form, views\); see"),
        (dict(save=lambda self, path: path), r"lacks save\(path, \*, provenance, overwrite\); see"),
        (dict(gaussians=lambda self: None, rebuild=None), r"lacks gaussians\(camera\), rebuild\(form\); see"),
        (dict(parameters=parameters(features=torch.zeros(7, 2))), "lacks parameters of one length: it has 60 means, .*, 7 features; see"),
        (dict(parameters=parameters(carried=torch.tensor(1.0))), "lacks parameters of one length: it has 60 means, .*, single carried; see"),
        (dict(parameters=parameters(features=[1], offsets=None)), "lacks tensors as the parameters features, offsets; see"),
        (dict(shared_parameters=lambda self: None), r"lacks shared_parameters\(\) that returns a dictionary; see"),
        (dict(shared_parameters=lambda self: {"w": [1]}), "lacks tensors as the parameters w; see"),
        (
            dict(traits=property(lambda self: Traits(plain=True), lambda self, traits: None), parameters=parameters(offsets=torch.zeros(60, 3))),
            "lacks the parameters means, .* shN, which its trait `plain` promises; see",
        ),
    ],
)
def test_what_does_not_fit_a_model_is_told_when_it_is_wrapped(members, said):
    with pytest.raises(SettingsError, match=said):
        wrapped(**members)


def test_methods_of_compiled_code_need_not_tell_what_they_take():
    assert lacking(model(shared_parameters=dict)) == []  # of which Python knows no signature


@pytest.mark.parametrize(
    ("name", "value", "kind"),
    [("trained", None, "TrainedScale"), ("notes", None, "list"), ("source", "a.ply", "Path or None"), ("digest", 7, "str"), ("traits", {}, "Traits")],
)
def test_attributes_of_another_type_are_told_when_it_is_wrapped(name, value, kind):
    odd = model()
    setattr(odd, name, value)
    with pytest.raises(SettingsError, match=f"this Odd .* lacks {name} of the type {kind}; see"):
        wrap_model(odd)


def test_parameters_that_fail_are_told_by_name():
    with pytest.raises(PluginError, match="family 'theirs' failed: ZeroDivisionError"):
        wrapped(parameters=lambda self: 1 / 0)


def without_a_color(self, camera=None):
    splats = VanillaModel.gaussians(self, camera)
    return replace(splats, sh=splats.sh[1:])


def with_a_root_of_0(self, camera=None):
    splats = VanillaModel.gaussians(self, camera)
    return replace(splats, means=splats.means + (splats.means - splats.means.detach()).norm(dim=1, keepdim=True).sqrt())


class Tinted(Theirs):
    """Its colors have a factor that all splats share."""

    def __init__(self, *args):
        super().__init__(*args)
        self.tint = torch.ones(3)

    def shared_parameters(self):
        return {"tint": self.tint}

    def copy(self):
        copied = super().copy()
        copied.tint = self.tint.clone().requires_grad_()
        return copied

    def gaussians(self, camera=None):
        splats = super().gaussians(camera)
        return replace(splats, sh=splats.sh * self.tint)


class Counting(Tinted):
    def gaussians(self, camera=None):
        with torch.no_grad():
            self.tint.mul_(0.999)
        return super().gaussians(camera)


class Ellipsoids(Theirs):
    """Its splats are told by covariances."""

    def gaussians(self, camera=None):
        splats = super().gaussians(camera)
        axes = rotations(splats.quats) * splats.scales[:, None, :]
        return replace(splats, covariances=axes @ axes.mT)


def test_splats_of_covariances_are_merged():
    raw, views = tiny.model(300).parameters(), tiny.cameras(2)
    merged, plain = (wrap_model(kind(raw), cameras=views).adapt(0.125, recipe="instant", most_splats=200).report for kind in (Ellipsoids, Theirs))
    assert merged.gaussians_after == plain.gaussians_after == 200
    assert merged.psnr_after() == pytest.approx(plain.psnr_after(), abs=0.5)


class Factors(Ellipsoids):
    """Its parameters are no scales and quaternions either."""

    def parameters(self):
        raw = super().parameters()
        return {"means": raw["means"], "features": raw["scales"], "opacities": raw["opacities"], "sh0": raw["sh0"]}


def test_inspect_examines_splats_of_covariances(tmp_path, capsys):
    file = registered(tmp_path / "a.own", lambda path, iteration: Factors(tiny.model().parameters(), TrainedScale(), Origin(path)))
    assert main(["inspect", str(file), "--no-viewers"]) == 0
    assert "sound; next: " in capsys.readouterr().out


class Leafless(Tinted):
    def shared_parameters(self):
        return {"tint": self.tint * 1}


def test_parameters_that_all_rows_share_are_looked_at_too():
    raw, views = tiny.model().parameters(), tiny.cameras(2)
    tinted = Tinted(raw)
    assert not torch.equal(wrap_model(tinted, cameras=views).adapt(0.25, **BRIEF, rates={"networks": 0.1}).model.tint, tinted.tint)
    with pytest.raises(PluginError, match=r"family 'theirs' changed its input in place \(tint\)"):
        wrap_model(Counting(raw), cameras=views).render(views[0])
    with pytest.raises(PluginError, match=r"copy\(\) has to return parameters that are leaves and require gradients; tint cannot be optimized"):
        wrap_model(Leafless(raw), cameras=views).adapt(0.25, **BRIEF)


@pytest.mark.parametrize(
    ("members", "said"),
    [
        (dict(gaussians=without_a_color), r"gaussians\(\) returned splats that do not fit together: sh: expected .* got \[59, 4, 3\]"),
        (dict(gaussians=with_a_root_of_0), r"gaussians\(\) has gradients with NaN or infinity in means;"),
        (dict(copy=lambda self: None), r"copy\(\) returned a NoneType, which lacks traits, "),
        (dict(row_opacities=lambda self, views=(): torch.full((60,), torch.nan)), r"row_opacities\(\) .* returned a tensor \[60\], not all finite"),
        (dict(rebuild=lambda self, form: None), r"rebuild\(form\) has to hold the splats that `form` returns; it called it 0 times"),
        (dict(rebuild=lambda self, form: form(self.gaussians()) and None), r"rebuild\(form\) .*; it holds 60 splats after it returned \d+"),
    ],
)
def test_what_a_family_returns_wrong_is_told_by_its_name(members, said):
    with pytest.raises(PluginError, match=f"family 'theirs': {said}"):
        wrapped(**members).adapt(0.25, **BRIEF)


def save_elsewhere(self, path, *, provenance, overwrite=False):
    return Path(path).with_name("elsewhere.ply")


def save_as_text(self, path, *, provenance, overwrite=False):
    with new_file(path, overwrite) as temporary:
        temporary.write_text("splats")
    return path


@pytest.mark.parametrize(
    ("save", "said"),
    [
        (save_elsewhere, r"save\(\) returned .*elsewhere\.ply, where it wrote no file"),
        (save_as_text, r"save\(\) wrote a file of the type unknown to .*new\.ply, which other programs take for a ply; write what the ending says"),
    ],
)
def test_a_file_that_is_not_what_it_is_called_never_appears(tmp_path, save, said):
    adapted = wrapped(save=save).adapt(0.5, recipe="instant", merge_to=1.0)
    with pytest.raises(PluginError, match=f"family 'theirs': {said}"):
        adapted.save(tmp_path / "new.ply")
    assert not list(tmp_path.iterdir())


def registered(path, load=lambda path, iteration: model(), **changes):
    """A file of a registered family."""
    path.write_bytes(b"theirs")
    family = Family("theirs", "Theirs", lambda files: Match(CERTAIN, "its name") if files.path == path else None, API_VERSION, load)
    register_model("theirs", replace(family, **changes))
    return path


def test_levels_of_a_family_that_writes_no_ply_end_in_a_sentence(tmp_path, capsys):
    own = type("Own", (Theirs,), {"save": save_as_text})
    file = registered(tmp_path / "a.own", lambda path, iteration: own(tiny.model().parameters(), TrainedScale(), Origin(path)))
    words = ["--viewer", "spark", "--recipe", "instant", "--output", str(tmp_path / "levels")]
    assert main(["levels", str(file), *words]) == 2
    assert "family 'theirs': save() wrote a file of the type unknown to" in capsys.readouterr().err


def test_a_model_is_called_as_its_family(tmp_path):
    with pytest.raises(PluginError, match="family 'theirs' loads Nameless, whose `family` is '3dgs'; set it to 'theirs'"):
        load_model(registered(tmp_path / "a.own", lambda path, iteration: type("Nameless", (VanillaModel,), {})(tiny.model().parameters())))


def test_a_loader_that_ends_the_process_is_told_by_name(tmp_path):
    with pytest.raises(PluginError, match=r"family 'theirs' cannot load .*: SystemExit: 0"):
        load_model(registered(tmp_path / "a.own", lambda path, iteration: sys.exit(0)))


def test_an_ending_without_its_dot_is_told(tmp_path):
    file = registered(tmp_path / "a.own", saves="own")
    with pytest.raises(CheckpointError, match=r"the family 'theirs' failed: .*`saves` must be the ending of a file's name, such as \.ply, got 'own'"):
        load_model(file)


def test_a_recipe_that_ends_the_process_is_told_by_name():
    register_recipe("theirs", lambda scale, network: sys.exit(0))
    with pytest.raises(PluginError, match=r"recipe 'theirs' failed at x0\.5: SystemExit: 0"):
        wrapped().adapt(0.5, recipe="theirs")


@pytest.mark.parametrize(
    ("members", "said"),
    [
        (dict(lacking=lambda self, needs: "no"), r"lacking\(\) has to return a list of sentences; it returned a str"),
        (
            dict(render=lambda self, *shot: (drawn := ReferenceBackend.render(self, *shot)).replaced(image=drawn.image.detach().numpy())),
            "has to return a Rendered with an image .*; it returned a ndarray",
        ),
        (dict(render=lambda self, *shot: ReferenceBackend.render(self, *shot).image), r"has to return a Rendered with an image \[24, 32, 3\]"),
        (
            dict(render=lambda self, *shot: (drawn := ReferenceBackend.render(self, *shot)).replaced(image=drawn.image.movedim(2, 0))),
            r"has to return a Rendered with an image \[24, 32, 3\]",
        ),
    ],
)
def test_what_a_backend_returns_wrong_is_told_by_its_name(members, said):
    register_backend("odd", type("Odd", (ReferenceBackend,), {"name": "odd", **members}))
    with pytest.raises(PluginError, match=f"backend 'odd':? {said}"):
        (base := wrap_model(tiny.model(), cameras=tiny.cameras(2), backend="odd")).render(base.cameras[0])
