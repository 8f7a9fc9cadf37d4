"""`evaluate`: its tables, and what cannot be judged."""

import json
import re
from dataclasses import replace

import pytest
import tiny
from commands_run import refused
from pages_read import record_of

from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.commands.adapt import adapt
from mipmap_plugin.commands.types import read_scale, refuse_repeated
from mipmap_plugin.evaluation.published import PUBLISHED
from mipmap_plugin.scenes import write_cameras

pytestmark = pytest.mark.usefixtures("few_views")


def test_evaluate_prints_a_table_and_writes_its_rows(run, model_folder, tmp_path):
    scene = tiny.scene(tmp_path / "scene")
    wanted = ["--scale", "1", "--scale", "1/4", "--recipe", "instant", "--protocol", "P1"]
    words = ["evaluate", model_folder, "--images", scene, "--output", tmp_path / "rows.json", *wanted]
    code, out, _ = run(*words)
    assert code == 0
    assert "truth: P1" in out and "real dB over 2 views\n" in out and "| x1 " in out and "| x0.25 " in out and "base, resized" in out
    assert out.endswith(f"\nwritten: {tmp_path / 'rows.json'}\npage: {tmp_path / 'rows.html'}\n")
    assert "instant, 1 of 2 judged views adapted to" in out  # of the folder's cameras, one is judged
    written = json.loads((tmp_path / "rows.json").read_text())
    rows = written["rows"]
    assert written["judged_views"] == [2] and written["notes"] == []
    assert [row["name"] for row in rows][:2] == ["base", "base"] and rows[0]["psnr_db"] > 50
    refused(run(*words), "rows.json exists already; pass --overwrite")


def test_a_page_does_not_outlive_its_rows(run, model_folder, tmp_path):
    words = ["evaluate", model_folder, "--images", tiny.scene(tmp_path / "scene"), "--output", tmp_path / "rows.json", "--scale", "1"]
    assert run(*words)[0] == 0 and (tmp_path / "rows.html").exists()
    assert run(*words, "--overwrite")[0] == 0 and (tmp_path / "rows.html").exists()
    assert run(*words, "--overwrite", "--no-report")[0] == 0 and not (tmp_path / "rows.html").exists()
    (tmp_path / "rows.html").write_text("<title>mine</title>")
    assert run(*words, "--overwrite", "--no-report")[0] == 0 and (tmp_path / "rows.html").exists()


def test_evaluate_says_where_a_file_is_adapted_to_images_of_another_filter_than_the_truths(run, model_folder, tmp_path):
    scene = tiny.scene(tmp_path / "scene")
    words = ["evaluate", model_folder, "--images", scene, "--scale", "1/2", "--recipe", "default", "--recipe", "instant", "--steps", "1"]
    told = "P1 makes photographs smaller by another filter (box) than base images are for default (pil-bicubic); --resize area adapts to"
    notes = []
    for options in (["--protocol", "P1"], ["--protocol", "P1", "--resize", "area"], ["--protocol", "P3"]):
        code, out, err = run(*words, *options, "--no-report", "--json")
        assert code == 0, err
        notes.append(json.loads(out)["notes"])
    assert [len(each) for each in notes] == [1, 0, 0] and notes[0][0].startswith(told)


def test_evaluate_says_which_rows_are_missing_and_that_no_row_is_exposed(run, model_folder, tmp_path, monkeypatch):
    few = replace(ReferenceBackend.capabilities, screen_filters=frozenset({"classic", "antialiased"}))
    monkeypatch.setattr(ReferenceBackend, "capabilities", few)
    (model_folder / "exposure.json").write_text(json.dumps({"view_0": [[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0]]}))
    words = ["evaluate", model_folder, "--images", tiny.scene(tmp_path / "scene"), "--backend", "reference"]
    exposed = "exposure.json changes 1 of 1 image, which is not applied here: part of every difference from a photograph is exposure"
    missing = r"there is no row 'window', since backend 'reference' cannot do this(, but cpu can)?: it has the screen filters .*, not window"
    code, out, _ = run(*words, "--scale", "1/2")
    assert code == 0 and re.fullmatch(missing, out.splitlines()[-3]) and out.splitlines()[-2] == exposed and "| window" not in out
    code, out, _ = run(*words, "--scale", "1", "--json")
    assert code == 0 and json.loads(out)["notes"] == [exposed]


def test_evaluate_and_tradeoff_tell_of_photographs_that_are_absent(run, model_folder, tmp_path):
    scene = tiny.scene(tmp_path / "scene")
    (scene / "test" / "view_1.png").unlink()
    note = "transforms_test.json: 1 listed image is absent; 1 camera is left out because the file has no w and h"
    words = [model_folder, "--images", scene, "--scale", "1/2", "--recipe", "instant", "--json"]
    code, out, err = run("evaluate", *words, "--output", tmp_path / "rows.json")
    assert code == 0 and f"mipmap-plugin: {scene}: {note}\n" in err
    assert json.loads(out)["judged_views"] == [1] and json.loads(out)["notes"][0] == note
    page = (tmp_path / "rows.html").read_text()
    assert note in page and "photographs, protocol P1, 1 view" not in page and "photographs, protocol P3, 1 view" in page
    code, out, err = run("tradeoff", *words, "--output", tmp_path / "out", "--no-picture", "--no-renderers", "--repeats", "1")
    assert code == 0 and f"mipmap-plugin: {scene}: {note}\n" in err and json.loads(out)["scales"][0]["notes"][0] == note


def test_evaluate_says_that_the_base_was_trained_on_what_is_judged(run, model_folder, tmp_path):
    """Of photographs without a split those are judged that the checkpoint holds out, and else all."""
    train, test = tiny.cameras(3), tiny.cameras(1, seed=9, split="test")
    unmarked = tiny.scene(tmp_path / "scene", train=[*train, replace(test[0], name="other")])
    marked = tiny.scene(tmp_path / "marked", test=[*test, replace(train[1], split="test")])
    (unmarked / "transforms_test.json").unlink()
    (unmarked / "transforms_train.json").rename(unmarked / "transforms.json")
    no_split = "scene: no photograph is marked as for testing, so of 4 photographs those are taken that the checkpoint holds out: 1"
    all_of_them = "scene: no photograph is marked as for testing, so of 4 photographs all are taken: 4 have poses that the checkpoint counts as"
    both = "cfg_args says no --eval: the checkpoint was trained on 2 of 2 photographed test views, so that no row, the base's included, is held out"
    halves = "cfg_args says --train_test_exp: the checkpoint was trained on half of each of 1 of 2 photographed test views"
    for options, scene, judged, note in [
        ("Namespace(eval=True)", unmarked, 1, no_split),
        ("Namespace(eval=False)", unmarked, 4, all_of_them),
        (None, unmarked, 4, all_of_them),
        ("Namespace(eval=False)", marked, 2, both),
        ("Namespace(eval=True, train_test_exp=True)", marked, 2, halves),
        ("Namespace(eval=True)", marked, 2, "the checkpoint was trained on 1 of 2 photographed test views of marked, whose test views are"),
        ("Namespace(eval=True, lod=30)", marked, 2, None),  # Scaffold-GS's option, by which other views are for testing
        (None, marked, 2, None),
    ]:
        (model_folder / "cfg_args").write_text(options) if options else (model_folder / "cfg_args").unlink()
        code, out, err = run("evaluate", model_folder, "--images", scene, "--scale", "1", "--no-report", "--json")
        assert code == 0, err
        told = json.loads(out)
        assert told["judged_views"] == [judged] and len(told["notes"]) == (note is not None)
        assert note is None or told["notes"][0].startswith(note)


def test_evaluate_does_not_say_that_no_view_is_for_testing_where_their_photographs_are_absent(run, model_folder, tmp_path):
    scene = tiny.scene(tmp_path / "scene", train=tiny.cameras(3))
    for photograph in (scene / "test").iterdir():
        photograph.unlink()
    code, out, err = run("evaluate", model_folder, "--images", scene, "--scale", "1", "--no-report", "--json")
    assert code == 0, err
    absent, unmarked = json.loads(out)["notes"]
    assert absent.startswith("transforms_test.json: 2 listed images are absent") and "scene: no photograph is marked as for testing" in unmarked


def test_evaluate_averages_several_scenes_and_prints_the_published_rows(run, model_folder, tmp_path):
    scenes = [tiny.scene(tmp_path / "one"), tiny.scene(tmp_path / "two")]
    words = ["--scale", "1/4", "--published", "nerf-synthetic"]
    code, out, _ = run("evaluate", model_folder, model_folder, "--images", *scenes, *words)
    assert code == 0
    assert "| one       | x0.25 | P3 " in out and "| mean of 2 | x0.25 | P3 " in out
    trained = "trained at 800 px for zoom-out and at 100 px for zoom-in; rows of other protocols, and of bases trained at another size"
    assert f"published, mean over the 8 scenes of NeRF-Synthetic, {trained}, are not comparable" in out and "Mipmap-GS (arXiv 2408.06286)" in out
    refused(run("evaluate", model_folder, "--images", *scenes, "--scale", "1/4"), "--images: give one for each checkpoint", "; got 2, for 1 of these")


def test_checkpoints_of_one_scene_are_told_apart_and_not_averaged(run, model_folder, tmp_path):
    scene, other = tiny.scene(tmp_path / "scene"), tiny.folder(tmp_path / "other", tiny.cameras(3) + tiny.cameras(1, seed=9, split="test"), seed=1)
    answer = run("evaluate", model_folder, other, "--images", scene, scene, "--scale", "1/2", "--output", tmp_path / "rows.json")
    rows = json.loads((tmp_path / "rows.json").read_text())["rows"]
    bases = {row["scene"]: row["psnr_db"] for row in rows if row["name"] == "base"}
    assert answer[0] == 0 and list(bases) == [f"scene, {model_folder}", f"scene, {other}"]
    pictures = [zoom["pictures"] for zoom in record_of(tmp_path / "rows.html")["zooms"]]
    assert [each["mean"]["psnr_db"] for zoom in pictures for each in zoom if each["name"] == "base"] == [*bases.values()]


@pytest.mark.parametrize("dataset", ["nerf-synthetic", "mip-nerf-360"])
def test_published_rows_that_do_not_exist_are_no_empty_table(run, model_folder, tmp_path, dataset):
    scene = tiny.scene(tmp_path / "one")
    out = run("evaluate", model_folder, "--images", scene, "--scale", "3/8", "--published", dataset, "--no-report")[1]
    said = out.splitlines()[-1].partition("they are at ")[2].replace(" and", ",").split(", ")
    assert {read_scale(scale) for scale in said} == {row.scale for row in PUBLISHED if row.dataset == dataset}


def test_an_option_that_counts_once_is_not_given_twice(run, model_folder, tmp_path):
    scenes = [tiny.scene(tmp_path / "one"), tiny.scene(tmp_path / "two")]
    twice = ["--images", scenes[0], f"--images={scenes[1]}"]
    refused(run("evaluate", model_folder, *twice, "--scale", "1/4"), "--images is given 2 times", "; give it once, with all its values behind it\n")
    budgets = ["--time-budget-s", "1", "--time_budget_s", "2"]
    refused(run("adapt", model_folder, "--scale", "1/4", *budgets), "--time-budget-s is given 2 times", "; give it once\n")
    refuse_repeated(adapt, ["adapt", "--json", "--json", "--scale", "1/4", "--scale", "4", "--seed", "1", "--", "--seed", "--seed"])


def test_a_lone_file_is_judged_by_photographs_with_the_cameras_that_are_given(run, tmp_path):
    scene, lone = tiny.scene(tmp_path / "scene", train=tiny.cameras(2)), tiny.ply(tmp_path / "a.ply")
    words = ["--images", scene, "--scale", "1/2", "--no-report", "--json"]
    code, out, err = run("evaluate", lone, *words, "--cameras", scene)
    assert code == 0 and {row["name"] for row in json.loads(out)["rows"]} > {"base", "scaled"}, err
    refused(run("evaluate", lone, *words), "its base scale is not known; give its model folder, or its cameras (--cameras)")
    quick = ["--output", tmp_path / "out", "--recipe", "instant", "--no-picture", "--no-renderers", "--repeats", "1", "--supersampling", "2"]
    assert run("tradeoff", lone, "--images", scene, "--scale", "1/2", *quick, "--cameras", scene)[0] == 0
    refused(run("evaluate", lone, *words, "--cameras", scene, scene), "--cameras: give one for each checkpoint", "; got 2, for 1 of these")


def test_evaluate_asks_for_a_checkpoint(run, tmp_path):
    refused(run("evaluate", "--images", tmp_path, "--scale", "1/2"), "there is no checkpoint to evaluate; give a PLY or a model folder")
    (tmp_path / "itself").symlink_to("itself")
    looped = run("evaluate", tmp_path / "itself", "--images", tmp_path, "--scale", "1/2")
    refused(looped, "itself is a link to itself, which does not exist; give a PLY file or a model folder")


def test_evaluate_refuses_what_cannot_be_judged(run, model_folder, tmp_path):
    scene = tiny.scene(tmp_path / "scene")
    refused(run("evaluate", tiny.ply(tmp_path / "a.ply"), "--images", scene, "--scale", "1"), "has no cameras, so its base scale is not known")
    refused(run("evaluate", model_folder, "--images", scene, "--scale", "4"), "the photographs have only 32 x 24")
    refused(run("evaluate", model_folder, "--images", tmp_path / "nowhere", "--scale", "1"), "there is no such file or folder")
    lpips = "evaluate", model_folder, "--images", scene, "--scale", "1", "--lpips-weights", tmp_path
    refused(run(*lpips), f"--lpips-weights {tmp_path}: say which LPIPS this is for; add --lpips alex, vgg or vgg-01")
    refused(run(*lpips, "--lpips", "alex"), f"{tmp_path} is a folder; give the file of the weights of alex in it")


def test_evaluate_refuses_a_wrong_seed_that_no_recipe_is_there_to_use(run, model_folder, tmp_path):
    words = ["evaluate", model_folder, "--images", tiny.scene(tmp_path / "scene"), "--scale", "1/2", "--seed", "-1"]
    refused(run(*words), "setting seed: must be a whole number", "got -1")


@pytest.mark.parametrize("setting, value", [("steps", "20"), ("steps", "-1"), ("resize", "area")])
def test_evaluate_refuses_settings_of_adapted_models_where_nothing_is_adapted(run, model_folder, tmp_path, setting, value):
    words = ["evaluate", model_folder, "--images", tiny.scene(tmp_path / "scene"), "--scale", "1/2", f"--{setting}", value]
    refused(run(*words), f"--{setting} {value}: it is of adapted models, and none is evaluated; add --recipe default")


def test_a_checkpoint_of_which_nothing_is_drawn_is_refused_before_the_work(run, tmp_path):
    faint = tiny.model()
    faint.parameters()["opacities"][:] = -8.0
    faint.save(tmp_path / "faint", provenance={})
    write_cameras(tmp_path / "faint" / "cameras.json", tiny.cameras(3))
    photographs = ["--images", tiny.scene(tmp_path / "scene"), "--scale", "1/2"]
    for words in (
        ["adapt", "--scale", "1/2"],
        ["levels", "--viewer", "spark", "--output", tmp_path / "levels"],
        ["tradeoff", "--scale", "1/2", "--output", tmp_path / "tradeoff"],
        ["evaluate", *photographs],
        ["adapt", "--scale", "1/2", "--tiles", "2", "--backend", "cpu"],
    ):
        refused(run(words[0], tmp_path / "faint", *words[1:]), "an opacity below 1/255")
