"""Quality against photographs: which truths are taken, and the rows of a table."""

from dataclasses import replace

import pytest
import tiny
import torch

from mipmap_plugin.errors import SettingsError
from mipmap_plugin.evaluation import photographs
from mipmap_plugin.evaluation.evaluate import Evaluator, Row, all_rows, evaluator_of, means, training_free_rows
from mipmap_plugin.evaluation.judged import judged_views
from mipmap_plugin.evaluation.metrics import psnr
from mipmap_plugin.evaluation.protocols import PROTOCOLS
from mipmap_plugin.evaluation.published import PUBLISHED, published
from mipmap_plugin.evaluation.report import markdown, published_table, records, table
from mipmap_plugin.models.base import TrainedScale
from mipmap_plugin.scenes import load_scene
from mipmap_plugin.wrap import Wrapped, wrap_model

pytestmark = pytest.mark.usefixtures("few_views")

BRIEF = dict(steps=2, extra_views=1, check_every=1)
BLACK = (0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Photographs of the model itself, at the base scale."""
    return load_scene(tiny.scene(tmp_path_factory.mktemp("scene"), train=tiny.cameras(3)))


@pytest.fixture
def model():
    return wrap_model(tiny.model(), cameras=tiny.cameras())


def evaluate(model, scene, scales, recipes, protocol, perceptual=None, **settings):
    return all_rows(model, evaluator_of(model, scene, protocol, perceptual), scales, recipes, **settings)


# Protocols


def test_test_views_are_brought_to_the_density_of_the_base(scene):
    base = tiny.cameras()[0]
    for scale in (1, 1 / 2):
        views = judged_views(scene, [base.zoomed(scale)], BLACK)
        assert [view.camera.name for view in views] == ["view_0", "view_1"]
        assert all(view.camera.split == "test" and view.camera.size == (24 * scale, 32 * scale) for view in views)
        assert all(view.photograph.shape == (24, 32, 3) for view in views)


def test_photographs_are_kept_in_bytes(scene):
    camera = next(iter(scene.images))
    read = scene.image(camera, BLACK)
    kept = photographs.packed(read)
    assert kept.dtype == torch.uint8 and torch.equal(photographs.unpacked(kept), read)
    every_level = (torch.arange(256).float() / 255).expand(2, 256)[..., None].expand(-1, -1, 3)
    assert photographs.packed(every_level).dtype == torch.uint8


def test_a_photograph_that_bytes_cannot_hold_keeps_its_bits():
    image = torch.full((24, 32, 3), 76.5 / 255)
    assert photographs.packed(image) is image and photographs.unpacked(image) is image


def test_beyond_the_limit_photographs_are_read_again(scene, monkeypatch):
    reads, image = [], type(scene).image
    monkeypatch.setattr(type(scene), "image", lambda self, camera, background: reads.append(camera) or image(self, camera, background))
    first, second = [*scene.images][:2]
    of_first, of_second = photographs.kept_photographs(scene, (first, second), BLACK, most_bytes=24 * 32 * 3)
    assert torch.equal(of_first(), image(scene, first, BLACK)) and torch.equal(of_second(), image(scene, second, BLACK))
    assert reads == [first, second, second]


def test_all_photographs_are_judged_by_where_none_is_a_test_view(scene):
    only_train = replace(scene, cameras=tuple(scene.split("train")))
    assert len(judged_views(only_train, tiny.cameras(), BLACK)) == 3


def test_a_scene_without_photographs_is_refused(scene):
    with pytest.raises(SettingsError, match="there are no photographs to compare with"):
        judged_views(replace(scene, images={}), tiny.cameras(), BLACK)


# Rows


def test_a_row_is_the_mean_over_the_views_of_each_views_decibel(scene):
    views = judged_views(scene, tiny.cameras(), BLACK)
    row = Evaluator(views, PROTOCOLS["P3"]).row("black", 1, lambda camera: torch.zeros(*camera.size, 3), gaussians=7)
    assert row.psnr_db == pytest.approx(sum(psnr(torch.zeros(24, 32, 3), view.photograph) for view in views) / 2)
    assert (row.name, row.scale, row.gaussians, row.adapt_seconds, row.adapted_on) == ("black", 1, 7, 0.0, "-")
    assert row.ms_per_view > 0 and row.protocol == "P3" and row.lpips is None


def test_the_base_against_photographs_of_itself_is_perfect(model, scene):
    views = judged_views(scene, tiny.cameras(), BLACK)
    [row] = training_free_rows(model, Evaluator(views, PROTOCOLS["P3"]), 1)
    assert row.name == "base" and row.psnr_db > 50 and row.ssim == pytest.approx(1.0, abs=1e-3)


def test_rows_for_every_scale_and_recipe(model, scene):
    rows = evaluate(model, scene, [1, 1 / 4], ["default", "paper"], "P1", **BRIEF)
    free = ["base", "scaled", "window", "antialiased", "supersampling, 4 x 4", "window, 2 x 2 samples", "base, resized"]
    assert [row.name for row in rows if row.scale == 1] == ["base"]
    zoomed = {row.name: row for row in rows if row.scale == 1 / 4}
    assert list(zoomed) == [*free, "default, held out", "default, scored", "paper, held out", "paper, scored"]
    assert zoomed["default, held out"].adapted_on == "4 train views and 1 around them"
    assert zoomed["paper, held out"].adapted_on == "the 4 train views"
    assert {zoomed[name].adapted_on for name in ("default, scored", "paper, scored")} == {"the 2 given views"}
    assert all(row.ssim is None for row in zoomed.values())
    assert zoomed["base, resized"].psnr_db > 45  # the photographs are the base's own, and P1 is a box
    assert zoomed["window, 2 x 2 samples"].psnr_db > zoomed["window"].psnr_db
    assert zoomed["supersampling, 4 x 4"].psnr_db > 45
    assert zoomed["base"].psnr_db < min(zoomed[name].psnr_db for name in ("base, resized", "default, held out"))
    assert zoomed["default, held out"].ended_by == "2 steps" and zoomed["base"].ended_by == ""
    assert table(rows).splitlines()[0].endswith("| ended by |") and "ended by" not in table([zoomed["base"]])


def test_a_maximum_of_steps_gives_none_to_a_recipe_without(model, scene):
    rows = {row.name: row.ended_by for row in evaluate(model, scene, [1 / 2], ["default", "instant"], "P3", **BRIEF)}
    assert (rows["default, held out"], rows["instant, held out"], rows["instant, scored"]) == ("2 steps", "0 steps", "0 steps")


def test_what_is_scored_is_the_last_state_and_what_is_held_out_the_best(model, scene, monkeypatch):
    returned, adapt = [], model.adapt
    monkeypatch.setattr(model, "adapt", lambda scale, **settings: returned.append(made := adapt(scale, **settings)) or made)
    evaluate(model, scene, [1 / 4], ["default"], "P3", **BRIEF)
    held_out, scored = (adapted.report for adapted in returned[-2:])
    assert (held_out.settings.returns, scored.settings.returns, scored.returned) == ("best", "last", "the last state")


def test_a_row_is_not_called_held_out_where_a_judged_pose_was_adapted_to(scene):
    """Without `eval` in cfg_args every camera of the checkpoint counts as one of training."""
    judged = [replace(camera, split="train", name="another") for camera in tiny.cameras(2, seed=9)]
    own = wrap_model(tiny.model(), cameras=[*tiny.cameras(2), judged[0]])
    rows = {row.name: row for row in evaluate(own, scene, [1 / 4], ["instant", "default"], "P3", **BRIEF) if row.ended_by}
    assert list(rows) == [f"{recipe}, {on}" for recipe in ("instant", "default") for on in ("1 of 2 judged views adapted to", "scored")]


def test_what_compiles_at_first_use_is_billed_to_no_adaptation(model, scene, monkeypatch):
    steps, real = [], Wrapped.adapt
    monkeypatch.setattr(Wrapped, "adapt", lambda *args, **settings: (steps.append(settings["steps"]), real(*args, **settings))[1])
    evaluate(model, scene, [1, 1 / 4], ["default"], "P3", **BRIEF)
    assert steps == [1, 2, 2]


def test_the_mean_over_scenes(model, scene):
    rows = evaluate(model, scene, [1, 1 / 4], ["instant"], "P3")
    better = [replace(row, scene="other", psnr_db=row.psnr_db + 2, ssim=None, gaussians=row.gaussians + 1) for row in rows]
    averaged = means([*rows, *better])
    assert [(row.scale, row.name) for row in averaged] == [(row.scale, row.name) for row in rows]
    assert {row.scene for row in averaged} == {"mean of 2"}
    for row, mean in zip(rows, averaged, strict=True):
        assert mean.psnr_db == pytest.approx(row.psnr_db + 1) and mean.ssim is None
        assert mean.adapted_on == row.adapted_on
    assert table([*rows, *averaged]).splitlines()[0].startswith("| scene ")


def test_the_mean_over_scenes_whose_worst_viewers_differ():
    rows = [Row(f"base in {viewer}, worst of 2", 1 / 2, "P3", psnr, None, 0.0, 1.0, 9) for viewer, psnr in (("spark", 20.0), ("classic", 30.0))]
    assert [(row.name, row.psnr_db, row.scene) for row in means(rows)] == [("base, worst of 2 viewers", 25.0, "mean of 2")]


@pytest.mark.parametrize("name", ["P2", None])
def test_an_unknown_protocol_is_refused_by_name(model, scene, name):
    with pytest.raises(SettingsError, match=f"there is no protocol '{name}'; choose from P1, P3, P4"):
        evaluate(model, scene, [1], [], name)


def test_rows_as_text_and_as_records(model, scene):
    rows = evaluate(model, scene, [1, 1 / 4], [], "P3")
    lines = table(rows).splitlines()
    assert len(lines) == 2 + len(rows) and len({len(line) for line in lines}) == 1
    assert lines[2].startswith("| x1 ") and f"{rows[0].psnr_db:.2f}" in lines[2]
    assert "| - " in lines[-1]  # no SSIM at 8 x 6 px
    assert all("| P3 " in line for line in lines[2:])
    assert records(rows)[0] == {**vars(rows[0])}


def test_lpips_has_a_column_that_says_which(model, scene):
    class Half:
        label = "LPIPS (half)"

        def __call__(self, image, truth):
            return None if image.shape[0] < 10 else 0.5

    rows = evaluate(model, scene, [1, 1 / 4], [], "P3", Half())
    head, _, first, *_, last = table(rows).splitlines()
    assert "| LPIPS (half) |" in head and "| 0.5000 " in first and "| - " in last
    assert (rows[0].lpips, rows[0].lpips_label, rows[-1].lpips) == (0.5, "LPIPS (half)", None)
    assert rows[1].name == "base"  # the untouched base, whose needles are crisp


def test_published_rows_name_their_protocol_and_source():
    rows = published("nerf-synthetic", [1 / 4, 2])
    assert {row.scale for row in rows} == {1 / 4, 2} and {row.dataset for row in rows} == {"nerf-synthetic"}
    head, _, *lines = published_table(rows).splitlines()
    assert "LPIPS (vgg, 0..1)" in head and len(lines) == len(rows)
    assert any("| x0.25 | P3 " in line and "Mipmap-GS, adapted on the scored views" in line and "| 32.51 " in line for line in lines)
    assert all(row.source and row.protocol in PROTOCOLS and 15 < row.psnr_db < 40 for row in PUBLISHED)


def test_a_markdown_table_pads_its_columns():
    assert markdown(["a", "long"], [["123", "4"]]) == "| a   | long |\n| --- | ---- |\n| 123 | 4    |"


@pytest.mark.parametrize(("settings", "said"), [({"viewer": "spark"}, "leave the viewer spark out"), ({"steps": -1}, "setting steps")])
def test_what_cannot_be_adapted_to_is_refused_before_anything_is_drawn(scene, monkeypatch, settings, said):
    base = wrap_model(tiny.model(trained=TrainedScale(keeps_filter=True)), cameras=tiny.cameras())
    monkeypatch.setattr(Wrapped, "render", None)
    with pytest.raises(SettingsError, match=said):
        evaluate(base, scene, [1 / 4], ["default"], "P3", **settings)
