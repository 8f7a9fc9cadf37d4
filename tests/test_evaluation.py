"""Quality against photographs: the metrics, how a truth is made, and the rows of a table."""

import math
from dataclasses import replace

import pytest
import tiny
import torch

from mipmap_plugin.adaptation.resize import resize
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.evaluation import protocols
from mipmap_plugin.evaluation.evaluate import evaluate, judge, training_free_rows
from mipmap_plugin.evaluation.metrics import psnr, ssim
from mipmap_plugin.evaluation.protocols import PROTOCOLS, resized_base
from mipmap_plugin.evaluation.report import markdown, records, table
from mipmap_plugin.scenes import load_scene
from mipmap_plugin.wrap import wrap_model

BRIEF = dict(steps=2, extra_views=1, check_every=1)


def noise(*shape, seed=0):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Photographs of the model itself, at the base scale."""
    return load_scene(tiny.scene(tmp_path_factory.mktemp("scene"), train=tiny.cameras(3)))


@pytest.fixture
def model():
    return wrap_model(tiny.model(), cameras=tiny.cameras(), backend="reference")


# Metrics


def test_psnr_is_the_mean_square_in_decibel_after_clamping():
    image, truth = noise(8, 9, 3), noise(8, 9, 3, seed=1)
    expected = -10 * math.log10(float((image - truth).double().square().mean()))
    assert psnr(image, truth) == pytest.approx(expected, abs=1e-5)
    assert psnr(truth + 5, truth) == pytest.approx(psnr(torch.ones(8, 9, 3), truth))


def gaussian_window_ssim(image, truth):
    """Wang et al. 2004 by hand: an 11 x 11 Gaussian window of sigma 1.5, only where it fits into the image."""
    offsets = torch.arange(11, dtype=torch.float64) - 5
    line = (-(offsets**2) / (2 * 1.5**2)).exp()
    window = (line[:, None] * line / line.sum() ** 2)[None, None]
    blur = lambda planes: torch.nn.functional.conv2d(planes, window)  # noqa: E731
    x, y = (each.double().movedim(-1, 0)[:, None] for each in (image, truth))
    mx, my = blur(x), blur(y)
    vx, vy, vxy = blur(x * x) - mx**2, blur(y * y) - my**2, blur(x * y) - mx * my
    c1, c2 = 0.01**2, 0.03**2
    return float(((2 * mx * my + c1) * (2 * vxy + c2) / ((mx**2 + my**2 + c1) * (vx + vy + c2))).mean())


def test_ssim_has_the_literatures_window():
    image = noise(20, 24, 3)
    truth = (image + 0.2 * noise(20, 24, 3, seed=1)).clamp(0, 1)
    assert ssim(image, truth) == pytest.approx(gaussian_window_ssim(image, truth), abs=1e-6)
    assert ssim(image, image) == pytest.approx(1.0)


def test_ssim_is_not_known_for_an_image_smaller_than_its_window():
    assert ssim(noise(10, 30, 3), noise(10, 30, 3)) is None
    assert ssim(noise(11, 11, 3), noise(11, 11, 3)) == pytest.approx(1.0)


# Protocols


def test_p1_truncates_the_mean_of_blocks_and_the_others_round_pillows_bicubic():
    photograph = noise(24, 32, 3)
    view = protocols.TestView(tiny.cameras(1)[0], photograph)
    levels = {name: view.truth(1 / 4, protocol) * 255 for name, protocol in PROTOCOLS.items()}
    torch.testing.assert_close(levels["P1"], (photograph.view(6, 4, 8, 4, 3).mean(dim=(1, 3)) * 255).floor(), atol=1e-3, rtol=0)
    for name in ("P2", "P3"):
        torch.testing.assert_close(levels[name], (resize(photograph, (6, 8), "pil-bicubic").clamp(0, 1) * 255).round(), atol=1e-3, rtol=0)


def test_a_truth_finer_than_the_photograph_is_refused():
    view = protocols.TestView(tiny.cameras(1)[0], noise(24, 32, 3))
    with pytest.raises(SettingsError, match="x2 asks for 64 x 48 px, but the photographs have only 32 x 24; evaluate a smaller scale"):
        view.truth(2, PROTOCOLS["P3"])


def test_test_views_are_brought_to_the_density_of_the_base(scene):
    base = tiny.cameras()[0]
    for scale in (1, 1 / 2):
        views = protocols.test_views(scene, base.zoomed(scale), (0.0, 0.0, 0.0))
        assert [view.camera.name for view in views] == ["view_0", "view_1"]
        assert all(view.camera.split == "test" and view.camera.size == (24 * scale, 32 * scale) for view in views)
        assert all(view.photograph.shape == (24, 32, 3) for view in views)


def test_all_photographs_are_judged_by_where_none_is_a_test_view(scene):
    only_train = replace(scene, cameras=tuple(scene.split("train")))
    assert len(protocols.test_views(only_train, tiny.cameras()[0], (0.0, 0.0, 0.0))) == 3


def test_a_scene_without_photographs_is_refused(scene):
    with pytest.raises(SettingsError, match="there are no photographs to judge by"):
        protocols.test_views(replace(scene, images={}), tiny.cameras()[0], (0.0, 0.0, 0.0))


def test_the_base_resized():
    image = noise(24, 32, 3)
    torch.testing.assert_close(resized_base(image, (6, 8)), resize(image, (6, 8), "box"))
    torch.testing.assert_close(resized_base(image, (7, 10)), resize(image, (7, 10), "area"))
    torch.testing.assert_close(resized_base(image, (48, 64)), resize(image, (48, 64), "pil-bicubic"))


# Rows


def test_a_row_is_the_mean_over_the_views_of_each_views_decibel(scene):
    views = protocols.test_views(scene, tiny.cameras()[0], (0.0, 0.0, 0.0))
    row = judge("black", lambda camera: torch.zeros(*camera.size, 3), views, 1, PROTOCOLS["P3"], gaussians=7)
    assert row.psnr_db == pytest.approx(sum(psnr(torch.zeros(24, 32, 3), view.photograph) for view in views) / 2)
    assert (row.name, row.scale, row.gaussians, row.adapt_seconds, row.adapted_on) == ("black", 1, 7, 0.0, "-")
    assert row.ms_per_view > 0


def test_the_base_against_photographs_of_itself_is_perfect(model, scene):
    views = protocols.test_views(scene, tiny.cameras()[0], (0.0, 0.0, 0.0))
    [row] = training_free_rows(model, views, 1, PROTOCOLS["P3"])
    assert row.name == "base" and row.psnr_db > 50 and row.ssim == pytest.approx(1.0, abs=1e-3)


def test_rows_for_every_scale_and_recipe(model, scene):
    rows = evaluate(model, scene, [1, 1 / 4], ["default", "paper"], "P1", **BRIEF)
    free = ["naive", "scaled", "antialiased", "resized base"]
    assert [row.name for row in rows if row.scale == 1] == ["base"]
    zoomed = {row.name: row for row in rows if row.scale == 1 / 4}
    assert list(zoomed) == [*free, "default, held out", "default, scored", "paper, held out", "paper, scored"]
    assert zoomed["default, held out"].adapted_on == "4 train views and 1 around them"
    assert zoomed["paper, held out"].adapted_on == "the 4 train views"
    assert {zoomed[name].adapted_on for name in ("default, scored", "paper, scored")} == {"the 2 given views"}
    assert all(row.ssim is None for row in zoomed.values())
    assert zoomed["resized base"].psnr_db > 45  # the photographs are the base's own, and P1 is a box
    assert zoomed["naive"].psnr_db < min(zoomed[name].psnr_db for name in ("resized base", "default, held out"))


def test_a_checkpoint_without_cameras_cannot_be_judged(scene):
    with pytest.raises(SettingsError, match="has no cameras, so its base scale is not known; give its model folder"):
        evaluate(wrap_model(tiny.model(), backend="reference"), scene, [1], [], "P3")


def test_rows_as_text_and_as_records(model, scene):
    rows = evaluate(model, scene, [1, 1 / 4], [], "P3")
    lines = table(rows).splitlines()
    assert len(lines) == 2 + len(rows) and len({len(line) for line in lines}) == 1
    assert lines[2].startswith("| x1 ") and f"{rows[0].psnr_db:.2f}" in lines[2]
    assert "| - " in lines[-1]  # no SSIM at 8 x 6 px
    assert records(rows)[0] == {**vars(rows[0])}


def test_a_markdown_table_pads_its_columns():
    assert markdown(["a", "long"], [["123", "4"]]) == "| a   | long |\n| --- | ---- |\n| 123 | 4    |"
