"""Report pages: one file, small, closed to the network, with the figures of the command's JSON."""

import json
import re
from dataclasses import replace
from importlib.resources import files

import pytest
import tiny
import torch
from pages_read import pixels, record_of

from mipmap_plugin import wrap_model
from mipmap_plugin.backends import register_backend
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.cli import main
from mipmap_plugin.evaluation.evaluate import Row
from mipmap_plugin.evaluation.shots import Shot
from mipmap_plugin.pages.gallery import Gallery
from mipmap_plugin.pages.html import LARGEST, write_page
from mipmap_plugin.pages.levels import lead
from mipmap_plugin.pages.record import Page, Picture, Zoom
from mipmap_plugin.pages.reports import adaptation_zoom, evaluation_page

pytestmark = pytest.mark.usefixtures("few_views")

TITLES = {"base": "base", "adapted": "adapted", "supersampled": "supersampling, 4 x 4", "truth": "truth"}
BRIEF = ["--views", "given", "--steps", "2"]


def pictures(size: int = 8) -> list[Picture]:
    noise = torch.rand(size, size, 3, generator=torch.Generator().manual_seed(0))
    return [Picture(title, role, noise, {"psnr_db": 20.0}, {"psnr_db": 21.0}) for role, title in TITLES.items()]


def fill(gallery, base, names, **settings):
    """Show what each name of a row is for: one view of the base, and an adaptation to x1/2 by it where it is none of the base."""
    camera, truth = base.cameras[0], base.render(base.cameras[0]).image
    for name in names:
        if not name.startswith(("base", "supersampling")):
            gallery.adapted(name, base.adapt(1 / 2, recipe="instant", **settings))
        gallery.shot(Shot(name, "ball", 1 / 2, camera, truth, truth, 20.0, None, None))


class OfFewSettings(ReferenceBackend):
    """As those of a GPU: it has no viewer's cut-offs."""

    name = "few"
    capabilities = replace(ReferenceBackend.capabilities, settings=frozenset())


def test_viewers_that_the_backend_lacks_are_left_out_with_its_reason(model_folder, tmp_path):
    register_backend("few", OfFewSettings)
    words = ["adapt", str(model_folder), "--scale", "1/2", "--report", "--output", str(tmp_path / "a.ply"), *BRIEF]
    assert main([*words, "--backend", "few"]) == 0
    zoom = record_of(tmp_path / "a.ply.report.html")["zooms"][0]
    why = r"Not drawn: backend 'few' cannot do this, but \w+ can: it does not support another least alpha"
    assert zoom["viewers"] == [] and re.match(why, zoom["no_viewers"])


def test_a_page_asks_the_network_for_nothing(tmp_path):
    text = write_page(tmp_path / "page.html", Page("levels", "", (), [Zoom("×1/4", 0.25, pictures())]), False).read_text()
    assert "default-src 'none'" in text
    assert all(link.startswith(("data:", "#")) for link in re.findall(r"(?:src|href)=\"([^\"]*)\"", text))
    assert not re.findall(r"url\(|@import|fetch\(|XMLHttpRequest|import\(", text)
    assert [address for address in re.findall(r"https?://[^\s\"']+", text) if address != "http://www.w3.org/2000/svg"] == []


def test_no_name_becomes_markup(tmp_path):
    name = "</script><script>alert(1)</script><!--"
    path = write_page(tmp_path / "page.html", Page(name, name, [name]), False)
    assert record_of(path)["title"] == name
    assert path.read_text().count("<script>alert") == 0


def test_a_page_of_many_large_pictures_stays_below_ten_megabytes(tmp_path):
    zooms = [Zoom(f"×{number}", number, pictures(600)) for number in (1, 2)]
    path = write_page(tmp_path / "page.html", Page("large", "", (), zooms), False)
    assert path.stat().st_size <= LARGEST + 4096
    [zoom, *_] = record_of(path)["zooms"]
    assert zoom["size"] == [600, 600] and zoom["shown"][0] < 600
    assert list(pixels(zoom["pictures"][0]["src"]).size) == zoom["shown"]


def test_the_page_of_evaluate_has_the_figures_of_its_json(model_folder, tmp_path, capsys):
    words = ["evaluate", model_folder, "--images", tiny.scene(tmp_path / "scene"), "--scale", "1/2", "--recipe", "instant", "--backend", "reference"]
    assert main([str(word) for word in (*words, "--output", tmp_path / "rows.json")]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == f"page: {tmp_path / 'rows.html'}"
    written, record = json.loads((tmp_path / "rows.json").read_text()), record_of(tmp_path / "rows.html")
    assert record["rows"] == written["rows"] and written["report"] == str(tmp_path / "rows.html")
    [zoom] = record["zooms"]
    assert zoom["label"] == "×1/2"
    assert [picture["role"] for picture in zoom["pictures"]][:4] == ["base", "adapted", "supersampled", "truth"]
    means = {row["name"]: {name: row[name] for name in ("psnr_db", "ssim", "lpips")} for row in written["rows"]}
    assert {picture["name"]: picture["mean"] for picture in zoom["pictures"] if picture["role"] != "truth"} == means
    assert [report["scale"] for report in record["adaptations"]] == [0.5, 0.5]
    assert record["commands"][0].startswith("mipmap-plugin evaluate ") and "--recipe instant" in record["commands"][0]
    assert zoom["no_viewers"] == "Not drawn: only the reference backend could, which takes too long here."


def test_a_file_for_a_viewer_is_compared_with_the_base_in_that_viewer(model_folder):
    pytest.importorskip("numba")
    base = wrap_model(model_folder, backend="cpu")
    gallery = Gallery(base, "itself")
    names = ("base", "base in spark", "base, resized", "supersampling, 2 x 2", "instant, held out", "instant, scored")
    fill(gallery, base, names, viewer="spark")
    [zoom] = gallery.zooms([], named=True)
    assert zoom.label == "ball ×1/2"
    roles = {picture.name: picture.role for picture in zoom.pictures}
    assert roles == {
        "base in spark": "base", "instant, held out": "adapted", "supersampling, 2 x 2": "supersampled", "truth": "truth",
        "base": "other", "base, resized": "other", "instant, scored": "other",
    }  # fmt: skip
    assert next(iter(roles)) == "base in spark" and [each.name for each in zoom.viewers if each.made_for] == ["spark"]


def test_a_file_for_several_viewers_is_told_of_by_the_worst_of_them(model_folder):
    base = wrap_model(model_folder)
    gallery, row = Gallery(base, "itself"), Row("", 1 / 2, "P3", 20.0, None, 3.0, 1.0, 9, scene="ball")
    fill(gallery, base, ("base in spark", "base in classic", "instant in spark", "instant in classic"))
    rows = [replace(row, name="base in classic, worst of 2"), replace(row, name="instant in spark, worst of 2", psnr_db=30.0)]
    page = evaluation_page("ball", [gallery], rows, commands=())
    assert page.lead == "×1/2 in the worst of 2 viewers: 20.0 dB as it is, 30.0 dB adapted in 3.0 s."
    assert [picture.name for picture in page.zooms[0].pictures[:3]] == ["base in classic", "base in spark", "instant in spark"]


def test_the_page_of_the_demo_does_not_say_that_adapted_is_adapted(monkeypatch):
    pytest.importorskip("numba")
    monkeypatch.setattr("mipmap_plugin.pages.in_viewers.VIEWERS", ("classic",))
    base = wrap_model(tiny.model(), cameras=tiny.cameras(3), backend="cpu")
    gallery = Gallery(base, "the ray-traced world")
    fill(gallery, base, ("base", "adapted"))
    [zoom] = gallery.zooms([Row(name, 1 / 2, "P3", 20.0, None, 3.0, 1.0, 9, scene="ball") for name in ("base", "adapted")])
    assert zoom.viewers and zoom.in_viewers == ""


def test_the_page_tells_of_the_default_recipe_by_name_in_whatever_order_recipes_were_asked_for(monkeypatch):
    pytest.importorskip("numba")
    monkeypatch.setattr("mipmap_plugin.pages.in_viewers.VIEWERS", ("classic",))
    base = wrap_model(tiny.model(), cameras=tiny.cameras(3), backend="cpu")
    gallery, row = Gallery(base, "itself", ["instant", "default"]), Row("base", 1 / 2, "P3", 20.0, None, 3.0, 1.0, 9, scene="ball")
    names = ["base", "instant, held out", "default, held out", "default, scored"]
    rows = [replace(row, name=name, psnr_db=20.0 + 5 * number) for number, name in enumerate(names)]
    for name in names:
        fill(gallery, base, [name])
        page = evaluation_page("ball", [gallery], rows, commands=())
        if name == "instant, held out":
            assert page.lead == "×1/2: 20.0 dB as it is, 25.0 dB adapted by instant in 3.0 s."
            assert not page.zooms[0].viewers  # whose pictures are not drawn twice
    assert page.lead == "×1/2: 20.0 dB as it is, 30.0 dB adapted by default in 3.0 s."
    assert page.zooms[0].facts(64)["in_viewers"] == "default, held out"
    assert [picture.name for picture in page.zooms[0].pictures] == ["base", "default, held out", "instant, held out", "truth", "default, scored"]


def test_each_scene_of_a_page_has_its_own_seconds():
    base = wrap_model(tiny.model(), cameras=tiny.cameras(3))
    image, galleries, rows = torch.zeros(8, 8, 3), [], list[Row]()
    for scene, seconds in (("ball", 3.0), ("cube", 7.0)):
        galleries.append(Gallery(base, "itself"))
        galleries[-1].restored("instant, held out", {"scale": 1 / 2, "effects": []})
        for name in ("base", "instant, held out"):
            galleries[-1].shot(Shot(name, scene, 1 / 2, base.cameras[0], image, image, 20.0, None, None))
            rows.append(Row(name, 1 / 2, "P3", 20.0, None, seconds, 1.0, 9, scene=scene))
    lead = evaluation_page("both", galleries, rows, commands=()).lead
    assert [part.split(" in ")[1] for part in lead.split("s.") if part] == ["3.0 ", "7.0 "]


def test_the_table_of_a_page_says_which_lpips_it_has():
    assert "lpips_label" in files("mipmap_plugin.pages").joinpath("sections.js").read_text()


def test_a_recipe_at_two_scales_is_adapted_at_both(model_folder):
    gallery = Gallery(wrap_model(model_folder), "itself")
    image = torch.zeros(8, 8, 3)
    for scale in (1 / 2, 1 / 4):
        gallery.restored("default", {"scale": scale})
        gallery.shot(Shot("default", "ball", scale, tiny.cameras()[0], image, image, 20.0, None, None))
    assert [zoom.pictures[0].role for zoom in gallery.zooms([])] == ["adapted", "adapted"]


def test_evaluate_without_an_output_takes_a_free_name_in_this_folder(model_folder, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    words = ["evaluate", "base", "--images", str(tiny.scene(tmp_path / "scene")), "--scale", "1"]
    assert [main([*words]), main([*words]), main([*words, "--no-report"])] == [0, 0, 0]
    assert sorted(path.name for path in tmp_path.glob("*.html")) == ["base.evaluation-2.html", "base.evaluation.html"]
    assert capsys.readouterr().out.count("page: base.evaluation") == 2


def test_the_page_of_adapt_has_the_figures_of_its_report(model_folder, tmp_path, capsys):
    words = ["adapt", str(model_folder), "--scale", "1/2", "--scale", "2", "--output", str(tmp_path / "out"), "--report", *BRIEF]
    assert main(words) == 0
    page = tmp_path / "out" / "base_adapted.report.html"
    assert capsys.readouterr().out.splitlines()[-1] == f"page: {page}"
    record = record_of(page)
    assert [zoom["label"] for zoom in record["zooms"]] == ["×1/2", "×2"]
    for zoom, report in zip(record["zooms"], record["adaptations"], strict=True):
        saved = json.loads((tmp_path / "out" / f"base_x{zoom['scale']:g}/point_cloud/iteration_30000/point_cloud.ply.adaptation.json").read_text())
        assert {name: report[name] for name in saved} == saved
        base, adapted = zoom["pictures"][:2]
        assert base["mean"] == {"psnr_db": saved["validation"]["the base as it is"]}
        assert adapted["mean"]["psnr_db"] in saved["validation"].values() and adapted["view"]["psnr_db"] > 0
    assert main([*words, "--overwrite"]) == 0


def test_adapt_writes_no_page_unless_asked(model_folder, tmp_path):
    assert main(["adapt", str(model_folder), "--scale", "1/2", "--output", str(tmp_path / "out.ply"), *BRIEF]) == 0
    assert not list(tmp_path.rglob("*.html"))


def test_the_page_of_a_tradeoff_has_the_points_of_its_json(model_folder, tmp_path, capsys):
    folder = tmp_path / "results"
    words = ["tradeoff", str(model_folder), "--scale", "1/2", "--output", str(folder), "--recipe", "instant", "--report"]
    words += ["--repeats", "1", "--views", "1", "--no-renderers", "--no-picture"]
    assert main(words) == 0
    record, written = record_of(folder / "report.html"), json.loads((folder / "tradeoff.json").read_text())
    assert record["tradeoffs"] == written["scales"] and record["provenance"] == written["machine"]
    assert capsys.readouterr().out.splitlines()[-1] == f"page: {folder / 'report.html'}"
    assert main(words) == 2


def test_the_page_of_levels_has_the_figures_of_their_manifest(model_folder, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("mipmap_plugin.levels.yardstick.VIEWS", 1)  # as where only one shows something
    monkeypatch.setattr("mipmap_plugin.levels.ladder.FEWER", 1.0)  # of a scene of few splats hardly any are merged
    words = ["levels", model_folder, "--viewer", "antialiased", "--coarsest", "1/2", "--ratio", "2", "--report", *BRIEF]
    assert main([str(word) for word in (*words, "--output", tmp_path / "ladder")]) == 0
    page = tmp_path / "ladder" / "report.html"
    assert capsys.readouterr().out.splitlines()[-1] == f"page: {page}"
    record, manifest = record_of(page), json.loads((tmp_path / "ladder" / "levels.json").read_text())
    assert record["ladder"] == manifest and record["title"] == "base: levels"
    [switch] = manifest["switches"]
    assert [zoom["scale"] for zoom in record["zooms"]] == pytest.approx(sorted({0.5, round(switch["zoom"], 9), 1.0}))
    means = {point["zoom"]: point for point in manifest["curve"]}
    for zoom in record["zooms"]:
        assert zoom["mean_of"] == "1 view that no level was adapted to"
        pictures = {picture["name"]: picture for picture in zoom["pictures"]}
        assert ("next level" in pictures) == (zoom["scale"] == switch["zoom"])
        assert [picture["role"] for picture in zoom["pictures"]][:3] == ["base", "adapted", "truth"]
        if point := means.get(zoom["scale"]):
            assert pictures["base in antialiased"]["mean"]["psnr_db"] == pytest.approx(point["base_db"])
    at_switch = next(zoom for zoom in record["zooms"] if zoom["scale"] == switch["zoom"])
    shown = next(picture for picture in at_switch["pictures"] if picture["name"] == "level shown")
    assert shown["mean"]["psnr_db"] == pytest.approx(switch["psnr_db"]) and shown["note"] == "level_0.ply"
    assert f"at worst {manifest['worst_db']:.1f} dB" in record["lead"]


@pytest.mark.parametrize(
    ("levels", "splats", "size", "told"),
    [(1, 1000, 2_000_000, "1 level for classic, 1,000 splats, 2.0 MB"), (2, 1000, 2_000_000, "2 levels for classic, 2,000 splats, 4.0 MB"),
     (1, 1, 2790, "1 level for classic, 1 splat, 3 kB")],
)  # fmt: skip
def test_the_lead_of_a_ladder_counts_its_levels_splats_and_bytes(levels, splats, size, told):
    facts = dict(viewer="classic", curve=[dict(base_db=20.0)], worst_db=20.0, mean_db=21.0, levels=[dict(splats=splats, bytes=size)] * levels)
    assert lead(facts, "at any zoom").startswith(f"{told}: at any zoom at worst 20.0 dB")


def test_zooming_in_is_compared_with_the_base_after_shrinking(model_folder):
    base = wrap_model(model_folder)
    zoom = adaptation_zoom(base, base.adapt(2, recipe="instant"))
    assert [picture.role for picture in zoom.pictures] == ["base", "adapted", "other"]
    assert zoom.truth.startswith("the base's own image, with which the image is compared after shrinking")
    assert zoom.view == "jittered_0000" and all(picture.view["psnr_db"] > 10 for picture in zoom.pictures)
