"""What a family of a stranger breaks is told in a sentence that names it, most of it before any work."""

from dataclasses import replace
from pathlib import Path

import pytest
import tiny
import torch
from their_families import BRIEF, Ellipsoids, Theirs, model, save_as_text, wrapped

from mipmap_plugin import load_model, register_model, wrap_model
from mipmap_plugin.cli import main
from mipmap_plugin.errors import CheckpointError, PluginError, SettingsError
from mipmap_plugin.models import API_VERSION, CERTAIN, Family, Match, TrainedScale, Traits
from mipmap_plugin.models.contract import lacking
from mipmap_plugin.models.vanilla import Origin, VanillaModel


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
        (dict(parameters=parameters(sh0=torch.zeros(60, 1, 3).half())), "lacks parameters of float32: it has sh0 of torch.float16; see"),
        (dict(parameters=parameters(quats=torch.ones(60, 4, dtype=torch.int64))), "lacks parameters of float32: it has quats of torch.int64; see"),
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


@pytest.mark.parametrize("name", ["traits", "trained"])
def test_an_attribute_that_fails_is_told_by_the_name_of_its_class(name):
    failing = property(lambda self: {}["level"], lambda self, value: None)
    with pytest.raises(PluginError, match="this Odd failed: KeyError: 'level'"):
        wrapped(**{name: failing})


def test_whole_numbers_may_be_carried(tmp_path):
    levels, unlike_3dgs = torch.ones(60, dtype=torch.int64), property(lambda self: Traits(), lambda self, traits: None)
    leveled = model(parameters=parameters(carried=levels), traits=unlike_3dgs)
    assert load_model(registered(tmp_path / "a.own", lambda path, iteration: leveled)).notes == []  # such as that float64 is slow


def test_parameters_that_fail_are_told_by_name():
    with pytest.raises(PluginError, match="family 'theirs' failed: ZeroDivisionError"):
        wrapped(parameters=lambda self: 1 / 0)


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


def save_elsewhere(self, path, *, provenance, overwrite=False):
    return Path(path).with_name("elsewhere.ply")


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


def test_an_ending_without_its_dot_is_told(tmp_path):
    file = registered(tmp_path / "a.own", saves="own")
    with pytest.raises(CheckpointError, match=r"the family 'theirs' failed: .*`saves` must be the ending of a file's name, such as \.ply, got 'own'"):
        load_model(file)
