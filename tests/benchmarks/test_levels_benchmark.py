"""The dolly benchmark's own parts: exact zooms, whole frames, flicker that only what is wrong makes, and a page from measured films."""

import json
from pathlib import Path
from types import SimpleNamespace

import pytest
import tiny
import torch
from levels import MANIFEST, Dolly, Show, at, changes, film, middle, shows
from levels_counts import Row
from levels_counts import page as page_of_counts
from levels_page import HEIGHT, WORDS, draw, page, strip
from levels_photographs import against, photograph
from PIL import Image

from mipmap_plugin import wrap_model
from mipmap_plugin.evaluation.judged import JudgedView as Shot
from mipmap_plugin.evaluation.protocols import PROTOCOLS


@pytest.fixture
def dolly(monkeypatch):
    """Three frames over a tiny scene."""
    monkeypatch.setattr("levels.FRAMES", 3)
    base = wrap_model(tiny.model(12, degree=0), cameras=tiny.cameras(2, width=16, height=12), backend="reference")
    return Dolly(base, base.cameras)


def test_zooms_are_exact_and_frames_hold_the_view():
    view = tiny.cameras(1, width=33, height=20)[0]
    for zoom in (1.0, 0.77, 0.1):
        camera = at(view, zoom)
        assert camera.fx == pytest.approx(zoom * view.fx) and camera.width % 2 == camera.height % 2 == 0
        assert camera.width >= zoom * view.width > camera.width - 2
        offset = zoom * (view.cx - view.width / 2)
        assert camera.cx - camera.width / 2 == pytest.approx(offset)


def test_the_middle_of_a_frame_is_what_the_next_frame_shows():
    image = torch.arange(6 * 8).view(6, 8, 1).expand(-1, -1, 3).float()
    assert torch.equal(middle(image, torch.zeros(2, 4, 3)), image[2:4, 2:6])


def test_the_base_at_its_own_scale_is_the_truth_and_does_not_flicker(dolly):
    show = Show("base", [dolly.base.model], [], 1.0)
    measured = film(dolly, show, "classic", dolly.truths())
    assert measured.frames[0].psnr_db > 60 and measured.frames[0].flicker is None
    assert measured.frames[-1].psnr_db < 40 and measured.frames[-1].flicker > 0
    assert [frame.zoom for frame in measured.frames] == pytest.approx([1, 1 / 4, 1 / 16])


def test_the_rival_makes_one_file_for_levels_of_as_many_splats(tmp_path, monkeypatch):
    """Its program refuses to write a file again."""
    base, made = wrap_model(tiny.folder(tmp_path / "base", tiny.cameras(2, width=16, height=12), count=12), backend="reference"), []
    levels = [{"file": base.model.source.name, "splats": count, "bytes": 1} for count in (12, 6, 6, 3)]
    (tmp_path / MANIFEST).write_text(json.dumps({"levels": levels, "switches": []}))
    (tmp_path / base.model.source.name).write_bytes(base.model.source.read_bytes())
    monkeypatch.setattr("levels.find_tool", lambda: ["tool"])
    monkeypatch.setattr("levels.decimated", lambda tool, source, count, output: (made.append(count), source)[1])
    monkeypatch.setattr(type(base), "adapt", lambda *_, **__: SimpleNamespace(save=lambda _: base.model.source))
    found = shows(base, "classic", tmp_path, tmp_path)
    assert sorted(made) == [3, 6] and len(found[-1].files) == 4


@pytest.fixture
def shot():
    """A test view of 16 x 12 px, and a photograph of four times its size."""
    camera = tiny.cameras(1, width=16, height=12)[0]
    return Shot(camera, (torch.rand(48, 64, 3, generator=torch.Generator().manual_seed(1)) * 255).round() / 255, Path("a.png"))


def test_a_photograph_of_a_frame_of_its_size_is_that_of_the_protocol(shot):
    for zoom in (1.0, 0.5):
        assert torch.equal(photograph(shot, at(shot.camera, zoom)), shot.truth(zoom, PROTOCOLS["P3"]))


def test_a_photograph_is_shrunk_by_exactly_the_zoom(shot):
    """A ramp stays a ramp, whose color says where each pixel of a frame lies in the photograph; beyond that its edge goes on."""
    ramp = torch.linspace(0, 252 / 255, 64).expand(48, 64)[..., None].expand(-1, -1, 3)
    shot = Shot(shot.camera, ramp, Path("a.png"))
    frame = at(shot.camera, 0.71)
    places = ((torch.arange(frame.width) + 0.5 - frame.width / 2) / 0.71 + 8) * 4 - 0.5
    found = photograph(shot, frame)[frame.height // 2, 1:-1, 0] * 63 * 255 / 252
    torch.testing.assert_close(found, places[1:-1], atol=0.3, rtol=0)


def test_only_pixels_within_the_photograph_are_compared(shot):
    frame = at(shot.camera, 0.71)
    truth = photograph(shot, frame)
    wrong = torch.zeros_like(truth)
    wrong[1:-1, 1:-1] = truth[1:-1, 1:-1]
    assert against(wrong, truth, shot.camera, 0.71) > 100 > against(wrong, truth, shot.camera, frame.width / 16)


def test_a_dolly_with_photographs_is_compared_with_them(dolly, monkeypatch):
    monkeypatch.setattr("levels.COARSEST", 1 / 4)
    dolly = Dolly(dolly.base, dolly.views)
    photographs = [Shot(view, dolly.truth(view, 1.0), Path("a.png")) for view in dolly.views]
    with_them = Dolly(dolly.base, dolly.views, photographs)
    show = Show("base", [dolly.base.model], [], 1.0)
    measured, ceiling = film(with_them, show, "classic", with_them.truths()), with_them.photo_db(with_them.truths())
    assert min(ceiling) > 40 and measured.frames[0].photo_db > 45
    assert measured.frames[-1].photo_db < ceiling[-1] - 3
    assert film(dolly, show, "classic", dolly.truths()).frames[0].photo_db is None


def test_files_change_at_their_switches(dolly):
    coarser = tiny.model(5, degree=0)
    show = Show("two", [dolly.base.model, coarser], [0.5], 1.0)
    assert show.file(0.51) is dolly.base.model and show.file(0.49) is coarser
    (change,) = changes(dolly, show, "classic")
    assert change.zoom == 0.5 and 0 < change.likeness_db < 60 < change.one_percent_db + 60


def test_the_page_compares_films():
    frames = [{"zoom": zoom, "psnr_db": psnr, "flicker": None if zoom == 1 else 2.0} for zoom, psnr in ((1, 38.0), (0.25, 34.0))]
    rival = [frame | {"psnr_db": frame["psnr_db"] - 9} for frame in frames]
    films = [{"name": name, "splats": [1000], "megabytes": 1.0, "frames": each} for name, each in (("levels", frames), ("base", rival))]
    change = {"zoom": 0.5, "step_db": 0.1, "likeness_db": 30.0, "one_percent_db": 29.0}
    text = page([{"base": "lego", "viewer": "spark", "films": films, "changes": [change], "seconds": [3.0, 2.0]}])
    assert "## lego in spark" in text and "5 s for all levels (3, 2)" in text
    cells = [[cell.strip() for cell in line.split("|")] for line in text.splitlines() if line.startswith("| base")]
    assert cells[0][1:5] == ["base", "25.0", "27.0", "9.0"]


def test_the_page_says_how_far_photographs_are_reached(tmp_path):
    """Results of before they counted have no such columns."""
    frames = [{"zoom": zoom, "psnr_db": 36.0, "flicker": 1.0, "photo_db": photo} for zoom, photo in ((1, 30.0), (0.25, 28.0))]
    film = {"name": "levels", "splats": [1000], "megabytes": 1.0, "frames": frames}
    result = {"base": "lego", "viewer": "spark", "films": [film], "changes": [], "seconds": [3.0], "supersampled_photo_db": [31.0, 33.0]}
    old = {key: value for key, value in result.items() if key != "supersampled_photo_db"}
    for text, dbs in ((page([result]), [["28.0", "29.0"], ["31.0", "32.0"]]), (page([old]), [])):
        rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if line.startswith(("| levels", "| supersampled"))]
        assert [cells[-2:] for cells in rows if len(cells) == 10] == dbs
    draw(tmp_path / "plot.png", [result, old])
    assert (tmp_path / "plot.png").stat().st_size > 0


def test_the_lead_of_a_count_is_over_the_better_rival():
    rivals = {"splat-transform": 26.0, "adaptive": 27.5}
    row = Row(0.5, 19_000, 0.5, 32.0, 60.0, 29.0, rivals, {"splat-transform": 30.0, "adaptive": 31.0})
    text = page_of_counts({"flowers_r8": [row]})
    cells = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if line.startswith("| 19,000")]
    assert cells == [["19,000", "x0.5", "32.0", "29.0", "26.0 (30.0)", "27.5 (31.0)", "+4.5", "60", "default"]] and "## flowers_r8" in text


def test_a_strip_has_a_row_for_each_way_and_a_column_for_each_zoom(tmp_path):
    red, blue = torch.tensor([1.0, 0, 0]), torch.tensor([0, 0, 1.0])
    rows = {"ours": [red.expand(4, 4, 3), red.expand(2, 2, 3)], "base": [blue.expand(4, 4, 3), red.expand(2, 2, 3)]}
    strip(tmp_path / "strip.png", rows, (1.0, 0.5))
    with Image.open(tmp_path / "strip.png") as sheet:
        middles_x, middles_y = (HEIGHT // 2, sheet.width - HEIGHT // 2), [row * (HEIGHT + WORDS) + WORDS + HEIGHT // 2 for row in (0, 1)]
        middles = [[sheet.getpixel((x, y)) for x in middles_x] for y in middles_y]
    assert middles == [[(255, 0, 0), (255, 0, 0)], [(0, 0, 255), (255, 0, 0)]]
