"""Pictures of report pages: what of an image is shown, in which viewers, and beside what."""

import re
from importlib.resources import files

import pytest
import tiny
import torch
from pages_read import pixels

from mipmap_plugin import wrap_model
from mipmap_plugin.errors import OutputExists
from mipmap_plugin.evaluation.metrics import SAME_DB
from mipmap_plugin.formats.images import data_uri
from mipmap_plugin.pages.html import html, write_page
from mipmap_plugin.pages.in_viewers import made_for_viewers, viewer_pictures, why_not
from mipmap_plugin.pages.record import Page, Picture, Zoom, zoom_name

pytestmark = pytest.mark.usefixtures("few_views")


def test_a_picture_shows_the_middle_of_an_image_pixel_by_pixel():
    image = torch.zeros(5, 7, 3)
    image[2, 3] = 1
    shown = pixels(data_uri(image, 3))
    assert shown.size == (3, 3) and shown.getpixel((1, 1)) == (255, 255, 255) and shown.getpixel((0, 0)) == (0, 0, 0)


def test_infinite_figures_are_none_in_the_record():
    picture = Picture("a", "base", torch.zeros(1, 1, 3), {"psnr_db": float("inf")})
    assert '"psnr_db": null' in html(Page("a", "", (), [Zoom("×1", 1, [picture])]).facts(4))


@pytest.mark.parametrize(("scale", "name"), [(0.25, "×1/4"), (1 / 3, "×1/3"), (4.0, "×4"), (0.3, "×0.3"), (1.0, "×1"), (1.5, "×1.5")])
def test_scales_are_written_as_people_write_them(scale, name):
    assert zoom_name(scale) == name


def test_the_page_knows_the_figure_of_identical_images():
    script = files("mipmap_plugin.pages").joinpath("dom.js").read_text()
    assert re.search(r"SAME_DB = (\d+)", script)[1] == f"{SAME_DB:g}"


def test_a_page_is_not_overwritten(tmp_path):
    (tmp_path / "page.html").write_text("mine")
    with pytest.raises(OutputExists, match="--overwrite"):
        write_page(tmp_path / "page.html", Page("a", "", ()), False)
    assert (tmp_path / "page.html").read_text() == "mine"


def test_viewers_show_the_base_and_the_file_beside_the_truth(monkeypatch):
    pytest.importorskip("numba")
    monkeypatch.setattr("mipmap_plugin.pages.in_viewers.VIEWERS", ("classic", "spark"))
    base = wrap_model(tiny.model(), cameras=tiny.cameras(3), backend="cpu")
    adapted = base.adapt(1 / 2, recipe="instant", viewer="spark")
    camera = base.cameras[0].zoomed(1 / 2)
    truth = base.render(camera, supersampling=2).image
    shown = viewer_pictures(base, adapted, camera, truth)
    assert why_not(base) == "" and made_for_viewers(adapted) == ["spark"]
    assert [each.name for each in shown] == ["spark", "classic"]
    assert [each.made_for for each in shown] == [True, False]
    assert torch.equal(shown[0].base.image, base.render(camera, viewer="spark").image)
    assert torch.equal(shown[0].adapted.image, adapted.render(camera).image)
    assert shown[0].adapted.view["psnr_db"] > shown[0].base.view["psnr_db"]


def test_a_large_image_is_drawn_in_viewers_as_the_window_around_its_middle(monkeypatch):
    pytest.importorskip("numba")
    monkeypatch.setattr("mipmap_plugin.pages.in_viewers.PIXELS", 64)
    monkeypatch.setattr("mipmap_plugin.pages.in_viewers.VIEWERS", ("spark", "classic"))
    base = wrap_model(tiny.model(), cameras=tiny.cameras(3), backend="cpu")
    camera = base.cameras[0]
    shown = viewer_pictures(base, base.adapt(1 / 2, recipe="instant"), camera, base.render(camera).image)
    classic = next(each for each in shown if each.name == "classic")
    assert classic.base.image.shape == (8, 8, 3) and classic.base.view["psnr_db"] > 50
    assert classic.made_for and shown[0] is classic
