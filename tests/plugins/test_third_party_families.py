"""Third-party families: recognized beside the built-in ones, and a broken one breaks nothing."""

import runpy
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import ply_files
import pytest
import tiny
import torch

from mipmap_plugin import load_model, register_model, wrap_model
from mipmap_plugin.cli import main
from mipmap_plugin.effects import MODEL_EFFECTS, Effect
from mipmap_plugin.errors import CheckpointError, PluginError, SettingsError
from mipmap_plugin.models import API_VERSION, CERTAIN, PLAIN, Family, Match, Traits, contract, detect
from mipmap_plugin.models.adapted_name import adapted_name
from mipmap_plugin.models.conformance import ModelSuite
from mipmap_plugin.models.families import BUILT_IN, find_family
from mipmap_plugin.models.reading import load_vanilla
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.scenes import write_cameras

pytestmark = pytest.mark.usefixtures("few_views")

EXAMPLE, FILES = (runpy.run_path(str(Path(__file__).parents[2] / "examples" / name)) for name in ("register_family.py", "register_family_files.py"))


def archive(path):
    np.savez(path, **{name: tensor.numpy() for name, tensor in tiny.model(40).parameters().items()})
    return path


def factors(path):
    return FILES["CholeskyModel"].from_gaussians(tiny.gaussians(40, degree=0)).save(path, provenance={})


def custom_family(**changes):
    """A family whose PLY is that of 3DGS with a column of its own."""
    family = Family("mine", "My splats", lambda files: Match(CERTAIN, "column mine") if "mine" in files.columns else None, API_VERSION, load_vanilla)
    return replace(family, **changes)


def ply(path, *columns):
    return ply_files.write(path, {**ply_files.splat_columns(8, bands=0), **{name: np.zeros(8, np.float32) for name in columns}})


class TestOfTheExample(ModelSuite):
    family, write, record = "npz", staticmethod(archive), EXAMPLE["FAMILY"]
    cameras = tuple(tiny.cameras())

    @pytest.fixture
    def checkpoint(self, tmp_path):
        register_model(self.family, self.record)
        return self.write(tmp_path / "scene.npz")


class TestOfAFamilyWithFilesOfItsOwn(TestOfTheExample):
    family, write, record = "cholesky", staticmethod(factors), FILES["FAMILY"]


@pytest.mark.parametrize(("family", "write", "name"), [(FILES, factors, "scene_x0.25.npz"), (EXAMPLE, archive, "scene_x0.25.ply")])
def test_an_adapted_file_keeps_the_suffix_by_which_its_family_knows_it(tmp_path, capsys, family, write, name):
    register_model(family["FAMILY"].name, family["FAMILY"])
    checkpoint = write(tmp_path / "scene.npz")
    write_cameras(tmp_path / "cameras.json", tiny.cameras())
    words = ["--cameras", tmp_path / "cameras.json", "--recipe", "instant", "--backend", "reference"]
    assert main(["adapt", str(checkpoint), "--scale", "1/4", *map(str, words)]) == 0, capsys.readouterr().err
    assert {file.name for file in tmp_path.iterdir()} == {"scene.npz", "cameras.json", name, f"{name}.adaptation.json"}
    assert len(load_model(tmp_path / name).parameters()["means"])


def test_an_archive_of_numpy_s_own_numbers_is_drawn_by_the_fast_backends(tmp_path):
    register_model("npz", EXAMPLE["FAMILY"])
    np.savez(tmp_path / "scene.npz", **{name: tensor.double().numpy() for name, tensor in tiny.model(40).parameters().items()})
    assert {tensor.dtype for tensor in load_model(tmp_path / "scene.npz").parameters().values()} == {torch.float32}


def test_a_family_that_loads_float64_is_told_what_draws_it(tmp_path):
    class Doubles(VanillaModel):
        family = "mine"

    def doubles(path, iteration):
        return Doubles.from_gaussians(tiny.gaussians(8).to(dtype=torch.float64))

    register_model("mine", custom_family(load=doubles))
    [note] = load_model(ply(tmp_path / "a.ply", "mine")).notes
    assert note == "family 'mine' loads float64, which only the slow backend reference draws; its load should return float32"


def test_a_numpy_archive_that_nobody_claims_is_told_to_be_one(tmp_path):
    with pytest.raises(CheckpointError, match=r"scene\.npz is a NumPy archive that no family knows; .* or register its family$"):
        detect(archive(tmp_path / "scene.npz"))


def test_an_adapted_file_of_a_family_that_is_absent_says_so(tmp_path):
    np.savez(tmp_path / "scene_x0.25.npz", means=np.zeros((1, 3)))
    (tmp_path / "scene_x0.25.npz.adaptation.json").write_text("{}")
    with pytest.raises(CheckpointError, match=r"npz was adapted from .* a family that is not installed here, or .* ending; install the package"):
        detect(tmp_path / "scene_x0.25.npz")


class OfAnyName(FILES["CholeskyModel"]):
    """Saves its arrays under any name, though its family knows only .npz."""

    def refuse_output(self, path, *, overwrite, networks_move=False):
        super().refuse_output(Path(f"{path}.npz"), overwrite=overwrite)

    def save(self, path, *, provenance, overwrite=False):
        return super().save(f"{path}.npz", provenance=provenance, overwrite=overwrite).rename(path)


def test_a_model_is_not_saved_under_a_name_that_its_family_does_not_know(tmp_path):
    register_model("cholesky", FILES["FAMILY"])
    model = OfAnyName.from_gaussians(tiny.gaussians(40, degree=0))
    with pytest.raises(PluginError, match=r"scene could not be read again, for no family .*; give it the ending by which"):
        contract.save(model, tmp_path / "scene", {})
    base = wrap_model(model, cameras=tiny.cameras())
    with pytest.raises(PluginError, match="no family recognizes"):
        ModelSuite().test_a_name_without_an_ending_is_refused_or_read_again(base, tmp_path)


@pytest.mark.parametrize(("traits", "on"), [
    (Traits(), ["view-dependent geometry"]), (Traits(moves=True), ["time"]), (Traits(same_for_all_views=True), []),
    (Traits(effects=(Effect("levels of detail", True, "it has some", "a comparison"),)), ["levels of detail"]),
])  # fmt: skip
def test_what_a_family_does_not_report_follows_from_its_other_traits(traits, on):
    model = tiny.model(10)
    model.traits = traits
    effects = wrap_model(model, cameras=tiny.cameras(), backend="reference").render(tiny.cameras()[0]).effects
    assert [effect.name for effect in effects if effect.on and effect.name in {each.name for each in MODEL_EFFECTS}] == on


def test_a_file_for_a_viewer_is_a_ply(tmp_path):
    register_model("cholesky", FILES["FAMILY"])
    assert adapted_name(factors(tmp_path / "scene.npz"), 0.25, "spark") == "scene_x0.25_spark.ply"


@pytest.mark.parametrize("ending", [".pt", ".npz"])
def test_other_files_become_a_folder(tmp_path, ending):
    """Those that a built-in family reads, and those that none does."""
    torch.save({"splats": {}}, tmp_path / f"a{ending}")
    assert adapted_name(tmp_path / f"a{ending}", 0.25, "gsplat") == f"a{ending}_x0.25_gsplat"


def test_a_recognized_family_can_be_read_once_a_loader_is_registered(tmp_path):
    path = ply(tmp_path / "a.ply", "trbf_center")
    with pytest.raises(CheckpointError, match="this is a SpacetimeGaussians checkpoint"):
        load_model(path)
    with pytest.raises(SettingsError, match="replace=True"):
        register_model("spacetime", custom_family(name="spacetime"))
    register_model("spacetime", replace(find_family("spacetime"), load=lambda path, iteration: tiny.model(3)), replace=True)
    assert len(load_model(path)) == 3


def test_a_family_may_put_itself_before_another(tmp_path):
    path = ply(tmp_path / "a.ply", "mine", "filter_3D")
    register_model("mine", custom_family())
    with pytest.raises(CheckpointError, match=r"claimed by 'mine' \(column mine\) and 'mip' .*; one of these families has to name the other"):
        detect(path)
    register_model("mine", custom_family(before=("mip",)), replace=True)
    assert detect(path).family == "mine"


def test_the_most_certain_match_wins(tmp_path):
    path = ply(tmp_path / "a.ply", "mine")
    register_model("mine", custom_family(recognize=lambda files: Match(PLAIN - 0.1, "a guess")))
    assert detect(path).family == "3dgs"
    register_model("mine", custom_family(), replace=True)
    assert detect(path).family == "mine"


def test_training_results_are_found_where_the_family_keeps_them(tmp_path):
    (tmp_path / "run/weights").mkdir(parents=True)
    for step in (5, 20):
        ply(tmp_path / f"run/weights/step_{step}.ply", "mine")
    register_model("mine", custom_family(place=("weights", r"step_(?P<step>\d+)\.ply")))
    checkpoint = detect(tmp_path / "run")
    assert (checkpoint.family, checkpoint.path.name, checkpoint.iteration) == ("mine", "step_20.ply", 20)
    assert detect(tmp_path / "run", iteration=5).path.name == "step_5.ply"


def test_above_a_run_its_adaptations_are_not_named(tmp_path):
    for name in ("run", "run_x0.25"):
        (tmp_path / name / "weights").mkdir(parents=True)
        ply(tmp_path / name / "weights/step_5.ply", "mine")
    (tmp_path / "run_x0.25/weights/step_5.ply.adaptation.json").write_text("{}")
    register_model("mine", custom_family(place=("weights", r"step_(?P<step>\d+)\.ply")))
    with pytest.raises(CheckpointError, match=r"lies above its checkpoint; give .*run$"):
        detect(tmp_path)


def test_a_place_that_another_family_shares_is_no_claim(tmp_path):
    (tmp_path / "run/ckpts").mkdir(parents=True)
    torch.save({"splats": {}}, tmp_path / "run/ckpts/ckpt_29999_rank0.pt")
    register_model("a first one", custom_family(name="a first one", place=("ckpts", r".*\.pt")))
    assert detect(tmp_path / "run").family == "gsplat"


def damaged(files):
    raise CheckpointError("this is no .mine file")


WRONG = ("high", 2.0, -1, float("nan"))


@pytest.mark.parametrize(
    ("target", "reason"),
    [
        ("no_such_package:FAMILY", "cannot be loaded: ModuleNotFoundError"),
        (lambda path: None, "is of type function; make it a mipmap_plugin.models.Family"),
        (custom_family(name="other"), "calls itself 'other'"),
        (custom_family(api_version=API_VERSION + 1), f"is written for API version {API_VERSION + 1}, but this package has API version {API_VERSION}"),
        (custom_family(recognize=lambda files: files.nothing), "has no attribute 'nothing'"),
        (custom_family(recognize=lambda files: True), "its recognize returns a bool; it has to be a Match or None"),
        (custom_family(recognize=lambda files: {}["level"]), "'mine' failed: KeyError: 'level'"),
        (custom_family(recognize=damaged), "'mine' failed: this is no .mine file"),
        *((custom_family(recognize=lambda files, sure=sure: Match(sure, "I say so")), "sure must be a number from 0 to 1") for sure in WRONG),
        (custom_family(before="3dgs"), "`before` must be a tuple of names, got '3dgs'"),
    ],
)
def test_a_broken_family_is_reported_and_breaks_nothing(tmp_path, target, reason):
    register_model("mine", target)
    for path in (tiny.folder(tmp_path / "base"), ply(tmp_path / "a.ply")):
        checkpoint = detect(path)
        assert checkpoint.family == "3dgs" and "the family 'mine' failed" in checkpoint.notes[0] and reason in checkpoint.notes[0]
    assert wrap_model(checkpoint.path).model.family == "3dgs"
    with pytest.raises(CheckpointError, match="the family 'mine' failed"):
        detect(ply_files.write(tmp_path / "points.ply", {name: np.zeros(2, np.float32) for name in "xyz"}))


@pytest.mark.parametrize("place", [("", r"(a\.ply"), ("", r"(?P<step>\w+)\.ply"), "weights", 7])
def test_a_broken_place_is_passed_over(tmp_path, place):
    register_model("mine", custom_family(place=place))
    assert detect(ply(tmp_path / "a.ply").parent).family == "3dgs"


def test_families_that_exclude_one_another_are_named(tmp_path):
    register_model("mine", custom_family(before=("yours", "3dgs")))
    register_model("yours", custom_family(name="yours", before=("mine",)))
    with pytest.raises(CheckpointError, match="claimed by '3dgs', 'mine', 'yours', each of which another comes before"):
        detect(ply(tmp_path / "a.ply", "mine"))


def lost(path, iteration):
    raise FileNotFoundError("its network")


@pytest.mark.parametrize(
    ("load", "said"),
    [
        (lambda path, iteration: {}["means"], "KeyError: 'means'"),
        (lambda path, iteration: sys.exit(0), "SystemExit: 0"),
        (lost, "FileNotFoundError: its network"),
        ("no_such_module:load", "ModuleNotFoundError: No module named 'no_such_module'"),
    ],
)
def test_a_loader_that_fails_is_told_by_its_name(tmp_path, load, said):
    register_model("mine", custom_family(load=load))
    with pytest.raises(PluginError, match=f"'mine' .*cannot .*: {said}"):
        load_model(ply(tmp_path / "a.ply", "mine"))


def test_a_loader_of_another_family_says_that_it_is_one(tmp_path):
    register_model("mine", custom_family())
    with pytest.raises(CheckpointError, match=r"a\.ply is a checkpoint of My splats, which is read in another way; load it with load_model"):
        load_vanilla(ply(tmp_path / "a.ply", "mine"))


def test_what_a_loaded_model_lacks_is_named(tmp_path):
    class Half:
        traits = tiny.model(2).traits
        family, trained, notes, source, folder, digest = "mine", None, [], None, None, ""

        def gaussians(self, camera): ...

        def parameters(self): ...

    register_model("mine", custom_family(load=lambda path, iteration: Half()))
    with pytest.raises(PluginError, match=r"loads Half, which lacks copy, replace_parameters, shared_parameters, .*, rebuild; see"):
        load_model(ply(tmp_path / "a.ply", "mine"))
    with pytest.raises(SettingsError, match=r"this Half has gaussians\(\) as a model has, but lacks copy"):
        wrap_model(Half())


def test_every_family_names_its_api_version():
    assert {family.api_version for family in BUILT_IN} == {API_VERSION}
    assert len({family.name for family in BUILT_IN}) == len(BUILT_IN)


@pytest.mark.parametrize(
    ("renamed", "message"),
    [({"means": "positions"}, "lacks the parameter 'means', a name of PARAMETERS for 'positions'"), ({"sh0": "albedo"}, "PARAMETERS for 'albedo'")],
)
def test_wrong_names_of_parameters_are_one_sentence(renamed, message):
    class Renamed(VanillaModel):
        def parameters(self):
            return {renamed.get(name, name): tensor for name, tensor in super().parameters().items()}

    with pytest.raises(SettingsError, match=message):
        wrap_model(Renamed(tiny.model(4).parameters()))
