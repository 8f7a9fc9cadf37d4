"""What is written in an exchange format, for which viewers, and what it has no place for."""

import gzip
from dataclasses import replace

import numpy as np
import pytest
import tiny
import torch
from exchange_files import RECORD, SPZ, answer_by, report_of, tool_request
from pages_read import record_of
from ply_files import write

from mipmap_plugin.cli import main
from mipmap_plugin.commands.ladders import Exports
from mipmap_plugin.errors import OutputError, SettingsError
from mipmap_plugin.formats.ply import read_ply
from mipmap_plugin.formats.readers import refuse_unread
from mipmap_plugin.levels.tiles import write_tile
from mipmap_plugin.models import load_model
from mipmap_plugin.models.outputs import cut_off
from mipmap_plugin.models.surfels import SurfelModel, flat_trained
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.wrap import wrap_model

pytestmark = pytest.mark.usefixtures("few_views")


def test_adapt_reads_and_writes_spz(tmp_path, tool, capsys):
    """The result is written beside the input, in the same format."""
    (tmp_path / "phone.spz").write_bytes(SPZ)
    assert main(["adapt", str(tmp_path / "phone.spz"), "--scale", "1/4", "--recipe", "instant"]) == 0
    assert (tmp_path / "phone_x0.25.spz").read_bytes().startswith(b"ply")  # the stand-in's
    assert tool_request(tool)[1].endswith("plain.ply") and tool_request(tool)[2].endswith("made.spz")
    assert report_of(tmp_path / "phone_x0.25.spz")["scale"] == 0.25
    assert {path.name for path in tmp_path.iterdir()} == {"phone.spz", "phone_x0.25.spz", "phone_x0.25.spz.adaptation.json"}
    assert main(["adapt", str(tmp_path / "phone.spz"), "--scale", "1/4", "--recipe", "instant"]) == 2
    assert "--overwrite" in capsys.readouterr().err


UP_TO_2, NONE = "reads .spz up to version 2, and splat-transform writes 3 at least", "read no .spz"
WITH_FILTER = "reads PLYs only, with a column filter_3D that .spz has no place for"
ONLY_2 = "UnityGaussianSplatting 1.1.1 reads .spz of version 2 only, and splat-transform writes 3 at least"
UNREAD = [("gaussian-splats-3d", UP_TO_2), ("mkkellogg", UP_TO_2), ("gsplat-js", NONE), ("drei", NONE), ("mip", WITH_FILTER), ("unity", ONLY_2)]


@pytest.mark.parametrize(("viewer", "why"), UNREAD)
def test_spz_is_not_written_for_a_viewer_that_does_not_read_it(tmp_path, tool, capsys, viewer, why):
    (tmp_path / "phone.spz").write_bytes(SPZ)
    words = ["adapt", str(tmp_path / "phone.spz"), "--scale", "1/4", "--recipe", "instant", "--viewer", viewer]
    assert main(words) == 2
    assert f"{why}; give a .ply by --output" in capsys.readouterr().err
    assert main([*words, "--output", str(tmp_path / "phone.ply")]) == 0


def test_spz_for_several_viewers_is_written_with_a_warning_of_those_that_do_not_read_it(tmp_path, recwarn):
    refuse_unread(tmp_path / "a.spz", ["spark", "three"])
    refuse_unread(tmp_path / "a.ply", ["spark", "gaussian-splats-3d"])
    assert not recwarn.list
    with pytest.warns(UserWarning, match=r"GaussianSplats3D .*; antimatter15/splat, .* read no .spz; give a .ply by --output if it is for these too"):
        refuse_unread(tmp_path / "a.spz", ["spark", "gaussian-splats-3d", "antimatter15"])
    with pytest.warns(UserWarning, match=r"PlayCanvas's engine .* read no \.spz, SuperSplat's editor does; give a \.ply by --output if"):
        refuse_unread(tmp_path / "a.spz", ["playcanvas"])


@pytest.mark.parametrize(
    ("name", "viewer"),
    [("a.sog", "unity"), ("a.sog", "three"), ("a.compressed.ply", "metalsplatter"), ("a.spz", "3dgs.cpp"), ("a.glb", "3dgs.cpp"), ("a.SOG", "brush")],
)
def test_no_format_is_written_for_a_viewer_that_does_not_read_it(tmp_path, tool, name, viewer):
    base = wrap_model(tiny.ply(tmp_path / "base.ply"))
    with pytest.raises(SettingsError, match=rf"{viewer} reads no .*; give a \.ply by --output"):
        base.refuse_output(tmp_path / name, overwrite=False, viewer=viewer)
    base.refuse_output(tmp_path / "a.ply", overwrite=False, viewer=viewer)
    base.refuse_output(tmp_path / "a.sog", overwrite=False, viewer="gdgs")


@pytest.mark.parametrize("name", ["a.sog", "a.spz", "a.glb", "a.compressed.ply"])
def test_no_file_by_itself_is_written_for_cesium_but_a_ply(tmp_path, name):
    """It opens 3D Tiles only, and was said to show a SOG."""
    with pytest.raises(SettingsError, match=r"Cesium opens splats in 3D Tiles only, which levels --tiles writes$"):
        refuse_unread(tmp_path / name, ["cesium"])
    with pytest.warns(UserWarning, match=r"a.ply: Cesium opens splats in 3D Tiles only, which levels --tiles writes$"):
        refuse_unread(tmp_path / "a.ply", ["cesium"])


@pytest.mark.parametrize("ending", [".spz", ".compressed.ply", ".ply"])
@pytest.mark.parametrize("viewer", [None, "antialiased"])
def test_splats_that_not_all_viewers_of_a_format_draw_as_trained_are_told_of(tmp_path, tool, ending, viewer, capsys):
    """Without a viewer they are for renderers of the training; whoever names a viewer knows it."""
    base, output = tiny.ply(tmp_path / "base.ply"), tmp_path / f"new{ending}"
    words = ["adapt", str(base), "--scale", "1/2", "--recipe", "instant", "--screen-filter", "antialiased", "--output", str(output)]
    assert main([*words, *(["--viewer", viewer] if viewer else [])]) == 0
    told = f"(antialiased, 0.3 px²), which not all viewers of {ending} do"
    count = int(viewer is None and ending != ".ply")
    assert capsys.readouterr().err.count(told) == sum(told in note for note in report_of(output)["notes"]) == count


@pytest.mark.parametrize("ending", [".spz", ".compressed.ply"])
def test_columns_that_a_format_has_no_place_for_are_told_of_and_in_the_report(tmp_path, tool, ending, capsys):
    """Normals that are not 0 too, which 3DGS does not have."""
    columns = {**read_ply(tiny.ply(tmp_path / "a.ply")).columns, "confidence": np.ones(60, np.float32), "nx": np.ones(60, np.float32)}
    write(tmp_path / "b.ply", columns)
    told = f"the extra columns nx, ny, nz, confidence are dropped, since {ending} has no place for them; a .ply has"
    file = tmp_path / f"c{ending}"
    assert main(["adapt", str(tmp_path / "b.ply"), "--scale", "1", "--output", str(file)]) == 0
    assert capsys.readouterr().err.count(told) == 1
    assert told in report_of(file)["notes"]
    assert main(["adapt", str(tmp_path / "b.ply"), "--scale", "1", "--output", str(tmp_path / "d.ply")]) == 0
    assert report_of(tmp_path / "d.ply")["notes"] == []


@pytest.mark.parametrize("ending", [".spz", ".compressed.ply", ".ply"])
def test_what_spz_cuts_off_is_told_of_and_in_the_report(tmp_path, tool, ending, capsys):
    """Its limits were in the documentation only. A thin splat's shorter axes do not count."""
    columns = dict(read_ply(tiny.ply(tmp_path / "a.ply")).columns)
    columns |= {axis: columns[axis] / 100 for axis in "xyz"}  # a small scene, of which the shortest length is seen
    columns["scale_0"][0], columns["f_dc_1"][1:3], columns["f_rest_4"][3], columns["scale_2"][4] = 6.5, -3.5, 1.5, -20
    for axis in range(3):
        columns[f"scale_{axis}"][5:9] = -10.5
    write(tmp_path / "b.ply", columns)
    made = tmp_path / f"c{ending}"
    assert main(["adapt", str(tmp_path / "b.ply"), "--scale", "1", "--output", str(made)]) == 0
    lost = "1 longer than 379 units, 4 shorter than 4.5e-05 units, 2 with a color of degree 0 outside -0.44 to 1.44, 1 with other harmonics"
    told = f"SPZ cuts off, of 60 splats, {lost} outside -1 to 1; a .ply keeps them"
    assert capsys.readouterr().err.count(told) == report_of(made)["notes"].count(told) == int(ending == ".spz")


def test_splats_lengthened_by_less_than_anybody_sees_are_not_told_of(tmp_path):
    """A zoom-out makes splats shorter than a pixel into dots, which in an SPZ are dots as well."""
    parameters = load_model(tiny.ply(tmp_path / "a.ply")).parameters()
    assert cut_off(tmp_path / "a.spz", {**parameters, "scales": torch.full_like(parameters["scales"], -10.5)}) == ""


@pytest.mark.parametrize("ending", [".spz", ".compressed.ply", ".ply"])
def test_bands_that_splat_transform_does_not_write_are_left_out_and_told_of(tmp_path, tool, ending, capsys):
    base, made = tiny.ply(tmp_path / "a.ply", degree=4), tmp_path / f"b{ending}"
    assert main(["adapt", str(base), "--scale", "1", "--output", str(made)]) == 0
    told, count = "SH bands above degree 3 are dropped, which splat-transform does not write; a .ply has them", int(ending != ".ply")
    assert capsys.readouterr().err.count(told) == report_of(made)["notes"].count(told) == count
    written, rest = read_ply(made).columns, [f"f_rest_{number}" for number in range(45 if count else 72)]  # the stand-in writes what it is given
    assert [name for name in written if name.startswith("f_rest")] == rest
    own = load_model(base).parameters()["shN"][:, 14, 2].detach()
    np.testing.assert_array_equal(written["f_rest_44" if count else "f_rest_62"], own)


def test_a_format_that_is_only_read_is_saved_as_a_ply(tmp_path, tool):
    (tmp_path / "phone.splat").write_bytes(RECORD * 3)
    assert main(["adapt", str(tmp_path / "phone.splat"), "--scale", "1/4", "--recipe", "instant"]) == 0
    assert len(load_model(tmp_path / "phone_x0.25.ply")) == 60


@pytest.mark.parametrize("name", ["out.splat", "out.KSPLAT"])
def test_no_folder_is_named_as_a_file_of_these_formats_is(tmp_path, name):
    with pytest.raises(SettingsError, match=r"is not written as K?SPLAT; give a \.ply"):
        tiny.model().save(tmp_path / name, provenance={})


@pytest.mark.parametrize("name", ["out.spz", "out.compressed.ply"])
def test_any_splats_are_written_so_where_the_name_asks_for_it(tmp_path, tool, name):
    tiny.model().save(tmp_path / name, provenance={})
    assert tool_request(tool)[2].endswith(name.partition(".")[2])
    assert len(read_ply(tmp_path / name).columns["x"]) == 60


def test_a_failed_writing_leaves_the_old_file(tmp_path, tool):
    answer_by(tool, "print('no room', file=sys.stderr)\nsys.exit(3)")
    (tmp_path / "out.spz").write_bytes(b"old")
    with pytest.raises(OutputError, match="no room"):
        tiny.model().save(tmp_path / "out.spz", provenance={}, overwrite=True)
    assert (tmp_path / "out.spz").read_bytes() == b"old" and [path.name for path in tmp_path.iterdir()] == ["out.spz"]


def test_what_no_viewer_of_it_shows_is_not_written(tmp_path, tool, monkeypatch):
    flat = SurfelModel(tiny.model().parameters(), flat_trained(tiny.model().trained))
    with pytest.raises(SettingsError, match=r"the filter of their own project \(surfel, 0.5 px²\); give a .ply or a folder"):
        flat.save(tmp_path / "out.spz", provenance={})
    monkeypatch.setenv("PATH", "")
    with pytest.raises(SettingsError, match="npm install"):
        tiny.model().save(tmp_path / "out.spz", provenance={})


def moved_by(offset):
    splats = tiny.gaussians()
    return VanillaModel.from_gaussians(replace(splats, means=splats.means + splats.means.new_tensor([0.0, 0.0, offset])))


@pytest.mark.parametrize(("offset", "why"), [(-5e5, r"500,00\d .* 0.0625 unit, more than half the size of 45 of 60"), (9e6, "9,000,00.* no room")])
def test_spz_is_not_written_of_splats_that_are_too_far_away_for_it(tmp_path, tool, offset, why):
    far, refused = moved_by(offset), f"{why}.*; remove what lies far away, move or shrink the scene, or give a .sog or a .ply"
    with pytest.raises(SettingsError, match=refused):
        far.save(tmp_path / "out.spz", provenance={})
    with pytest.raises(SettingsError, match=refused):  # before any work
        wrap_model(far, cameras=tiny.cameras(2)).refuse_output(tmp_path / "out.spz", overwrite=False)
    far.save(tmp_path / "out.ply", provenance={})
    with pytest.raises(SettingsError, match="move or shrink the scene, or open the level itself"):
        write_tile(tmp_path / "out.ply", tmp_path / "out.glb")
    assert not (tmp_path / "out.glb").exists()
    far.save(tmp_path / "out.compressed.ply", provenance={})


def test_a_splat_far_away_takes_no_spz_from_a_scene_whose_splats_are_larger_than_its_steps(tmp_path, tool):
    """Other writers keep 12 bits of fractions, so that nothing was written of splats 2,048 units away or more; the format has room for fewer."""
    model = VanillaModel.from_gaussians(tiny.gaussians())
    model.parameters()["means"].data[0] = 5000.0
    assert model.save(tmp_path / "out.spz", provenance={}).is_file()


@pytest.mark.parametrize("name", ["a.sog", "a.spz", "a.glb", "a.compressed.ply"])
def test_no_splats_are_refused_in_a_sentence(tmp_path, tool, name):
    splats = tiny.gaussians()
    none = replace(splats, **{part: value[:0] for part, value in vars(splats).items() if torch.is_tensor(value)})
    with pytest.raises(SettingsError, match=f"{name}: there are no splats to write, which this format needs; give a .ply$"):
        VanillaModel.from_gaussians(none).save(tmp_path / name, provenance={})


def test_levels_in_tiles_are_refused_of_such_splats_before_any_work(tmp_path, tool, capsys, monkeypatch):
    monkeypatch.setattr("mipmap_plugin.levels.ladder.make_levels", None)
    moved_by(5e5).save(tmp_path / "city.ply", provenance={})
    assert main(["levels", str(tmp_path / "city.ply"), "--viewer", "cesium", "--output", str(tmp_path / "ladder"), "--tiles"]) == 2
    assert "more than half the size of 45 of 60 splats" in (told := capsys.readouterr().err) and "leave --tiles out" in told


def test_a_splat_transform_that_is_too_old_for_sog_is_found_before_the_work(tmp_path, tool):
    answer_by(tool, "print('splat-transform v2.6.0 (b42b60c)', file=sys.stderr)")
    with pytest.raises(SettingsError, match=r"splat-transform 2.6.0 is too old for it, and 2.7 or newer is needed"):
        tiny.model().refuse_output(tmp_path / "a.sog", overwrite=False, networks_move=False)
    tiny.model().refuse_output(tmp_path / "a.spz", overwrite=False, networks_move=False)
    answer_by(tool, "print('splat-transform v2.0.6', file=sys.stderr)")
    with pytest.raises(SettingsError, match=r"2.0.6 is too old for it, and 2.1 or newer is needed; run: npm install -g \S+; or give a .ply"):
        tiny.model().refuse_output(tmp_path / "a.spz", overwrite=False, networks_move=False)
    with pytest.raises(SettingsError, match=r"3.0 or newer is needed, which needs Node.js 22; run: npm install -g \S+; or leave Streamed SOG out$"):
        Exports(streamed_sog=True, tiles=False, canvas=512).check(tmp_path)


def test_without_splat_transform_a_sog_is_not_said_to_be_written_by_it(tmp_path, tool):
    (tool / "splat-transform").unlink()
    with pytest.raises(SettingsError, match=r"a.sog: this format takes splat-transform, which is not installed; .*; or give a .ply$"):
        tiny.model().refuse_output(tmp_path / "a.sog", overwrite=False, networks_move=False)


@pytest.fixture
def rounding(tool):
    """The stand-in writes SPZ that it reads as `answer.ply`, another model: as if the format rounded a lot."""
    script = (tool / "splat-transform").read_text()
    (tool / "splat-transform").write_text(script + f"pathlib.Path(target).write_bytes({gzip.compress(SPZ)!r}) if target.endswith('.spz') else None\n")
    tiny.model(seed=5).save(tool / "answer.ply", provenance={}, overwrite=True)


@pytest.mark.usefixtures("rounding")
def test_the_db_of_a_file_are_of_what_its_format_keeps(tmp_path, capsys):
    words = ["--scale", "1/4", "--steps", "0", "--viewer", "classic"]
    source = tiny.ply(tmp_path / "scan.ply")
    assert main(["adapt", str(source), *words, "--output", str(tmp_path / "scan.spz"), "--report"]) == 0
    said = capsys.readouterr()
    report = report_of(tmp_path / "scan.spz")
    exact = next(psnr for state, psnr in report["validation"].items() if report["returned"].startswith(state))
    assert report["written"] < exact - 1
    assert f"-> {report['written']:.2f} dB on views" in said.out
    record = record_of(tmp_path / "scan.spz.report.html")
    [picture] = [picture for picture in record["zooms"][0]["pictures"] if picture["role"] == "adapted"]
    assert picture["mean"] == {"psnr_db": report["written"]} and picture["view"]["psnr_db"] < exact - 1
    assert f"→ {report['written']:.1f} dB on views" in record["lead"] and record["adaptations"][0]["written"] == report["written"]
    assert "its format rounds splats, which costs" in said.err and any("its format rounds splats" in note for note in report["notes"])
    base = report["validation"]["the base as it is"]
    worse = f"the file is worse than its base ({base:.2f} dB); keep the base, or give a .ply"
    assert report["written"] < base and worse in said.err and any(worse in note for note in report["notes"])


@pytest.mark.usefixtures("rounding")
def test_a_page_has_the_db_of_a_file_whose_path_is_relative(tmp_path, monkeypatch):
    tiny.ply(tmp_path / "scan.ply")
    monkeypatch.chdir(tmp_path)
    assert main(["adapt", "scan.ply", "--scale", "1/4", "--steps", "0", "--output", "new.spz", "--report", "--quiet"]) == 0
    written = report_of(tmp_path / "new.spz")["written"]
    assert rf"\u2192 {written:.1f} dB on views" in (tmp_path / "new.spz.report.html").read_text()


@pytest.mark.usefixtures("rounding")
def test_the_db_in_each_of_several_viewers_are_of_what_a_format_keeps(tmp_path):
    adapted = wrap_model(tiny.ply(tmp_path / "scan.ply")).adapt(1 / 4, steps=0, merge_to=1.0, viewer="portable")
    exact, files = adapted.report.viewers, [adapted.save(tmp_path / f"a.{suffix}") for suffix in ("ply", "spz")]
    ply, spz = (report_of(file)["viewers"] for file in files)
    assert ply == exact and spz.keys() == exact.keys() and spz["classic"] < exact["classic"] - 1


def test_a_ply_is_not_measured_again(tmp_path, capsys):
    words = ["--scale", "1/4", "--steps", "0"]
    assert main(["adapt", str(tiny.ply(tmp_path / "scan.ply")), *words, "--output", str(tmp_path / "out.ply")]) == 0
    assert report_of(tmp_path / "out.ply")["written"] is None
