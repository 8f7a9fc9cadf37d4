"""What cannot be cut into tiles is refused in a sentence, and what is left out is told."""

import shutil
from dataclasses import replace
from types import SimpleNamespace

import anchor_checkpoints
import numpy as np
import pytest
import tiny
import torch
from cut_scenes import cut_in_three, report, rewritten

from mipmap_plugin.cli import main
from mipmap_plugin.errors import BackendUnavailable, CheckpointError, OutputError, SettingsError
from mipmap_plugin.formats.magic import SPLAT_RECORD
from mipmap_plugin.formats.torch_file import load_torch
from mipmap_plugin.jobs.base import Base
from mipmap_plugin.jobs.job import Job
from mipmap_plugin.models import load_model
from mipmap_plugin.models.health import ACTIVATED
from mipmap_plugin.tiles import plan, reading
from mipmap_plugin.tiles.folder import BASE, CUT, work_folder
from mipmap_plugin.tiles.plan import refuse
from mipmap_plugin.tiles.reading import find_splats, make_cut
from mipmap_plugin.tiles.run import adapt_all_in_tiles, adapt_in_tiles
from mipmap_plugin.tiles.scene import opened


def test_columns_that_tiles_do_not_hold_are_told_of(job):
    file = rewritten(job, lambda columns: columns | {"label": columns["x"], "nz": columns["x"]})  # normals, which 3DGS does not have
    scene = cut_in_three(job)
    with pytest.warns(UserWarning, match="the extra columns nx, ny, nz, label are dropped, since tiles hold none"):
        assert report(scene, file).notes


def test_a_second_set_of_colors_that_is_left_out_is_told_of(job):
    file = rewritten(job, lambda columns: columns | dict.fromkeys(("red", "green", "blue"), columns["x"]))
    [note] = report(cut_in_three(job), file).notes
    assert note.startswith("its columns red, green and blue are left out")


def test_colors_up_to_255_are_those_of_the_whole_file_also_where_a_part_is_dark(job, monkeypatch):
    monkeypatch.setattr("mipmap_plugin.tiles.reading.CHUNK", 30)
    colors = dict.fromkeys(("red", "green", "blue"), np.repeat(np.float32([255, 5]), 40))
    file = rewritten(job, lambda columns: {name: column for name, column in columns.items() if not name.startswith("f_dc")} | colors)
    read = cut_in_three(job).base.parameters(torch.arange(80))["sh0"]
    torch.testing.assert_close(read, load_model(file).parameters()["sh0"], rtol=0, atol=1e-6)


def test_bands_that_the_loader_of_a_viewer_does_not_read_are_told_of(job):
    [file] = job.base.checkpoint.rglob("*.ply")
    tiny.model(80).with_degree(4).save(file, provenance={}, overwrite=True)
    scene = cut_in_three(job)
    scene.viewer = "spark"
    with pytest.warns(UserWarning, match="SH bands above degree 3 are left out, which loaders of spark do not read right"):
        assert report(scene, file).notes


def with_blank_rows(job, count):
    """Of four times as many splats, of which the last `count` are not there yet."""
    return rewritten(job, lambda columns: {name: np.append(np.tile(column, 4)[: 4 * len(column) - count], np.zeros(count, column.dtype))
                                           for name, column in columns.items()})  # fmt: skip


def test_a_download_that_has_not_ended_is_not_cut_either(job):
    with_blank_rows(job, 4)
    with pytest.raises(CheckpointError, match=r"is not whole: 4 of 320 rows hold nothing but zeros, as where a download"):
        cut_in_three(job)


def test_a_few_rows_of_zeros_are_in_no_tile(job):
    file = with_blank_rows(job, 3)
    with pytest.warns(UserWarning, match="3 of 320 splats were dropped: they hold nothing but zeros"):
        scene, whole = cut_in_three(job), load_model(file)
    assert sum(map(len, scene.cores)) == len(whole) == 317


def test_places_that_float32_does_not_hold_are_told_of(job):
    rewritten(job, lambda columns: columns | {"x": columns["x"].astype(float) + 5e6})
    folder = work_folder(job.target)
    folder.mkdir()
    with pytest.warns(UserWarning, match=r"80 of 80 splats lie so far .* steps of 0.5 units"):
        make_cut(job.base.checkpoint, 2, folder)


def test_splats_that_are_doubtful_or_left_out_are_told_of(job):
    def doubtful(columns):
        tiled = {name: np.tile(column, 2) for name, column in columns.items()}
        return tiled | {"opacity": np.linspace(0, 1, 160, dtype=np.float32), "x": np.append(np.float32(np.nan), tiled["x"][1:])}

    file = rewritten(job, doubtful)
    with pytest.warns(UserWarning, match=r"the opacities look like 0..1"), pytest.warns(UserWarning, match="1 of 160 splats was dropped"):
        scene = cut_in_three(job)
    told = report(scene, file)
    assert told.notes == [ACTIVATED, "1 of 160 splats was dropped: not finite once activated"] and told.gaussians_before == 159


@pytest.mark.parametrize(
    ("changes", "tiles", "reason"),
    [
        ({}, 1, "give at least 2, got 1"),
        ({"scale": 4.0}, 2, "cut into tiles for a zoom-out"),
        ({"scale": 1.0}, 2, "x1: the base is right as it is"),
        ({"viewer": "portable"}, 2, "stands for several; give one of them"),
        ({"settings": {"most_splats": 10}}, 2, "to no number of splats"),
    ],
)
def test_requests_that_no_tiles_serve(job, changes, tiles, reason):
    with pytest.raises(SettingsError, match=reason):
        adapt_in_tiles(replace(job, **changes), tiles)
    assert not work_folder(job.target).exists()


def test_of_a_file_that_is_read_part_by_part_any_part_tells_its_sh_degree(job, monkeypatch):
    """And no camera sees a splat that is not finite."""
    monkeypatch.setattr(reading, "CHUNK", 7)
    monkeypatch.setattr(reading, "SAMPLE", 1)
    row = np.arange(80)

    def changed(columns):
        one_row = {name: column * (row == 50) for name, column in columns.items() if name.startswith("f_rest_")}
        return {**columns, **one_row, "opacity": np.where(row == 30, np.float32(np.nan), columns["opacity"])}

    with pytest.warns(UserWarning, match="1 of 80 splats was dropped"):
        make_cut(rewritten(job, changed), 2, job.target.parent)
    stored = load_torch(job.target.parent / CUT)
    assert stored["sample"].tolist() == [0, 50] and stored["places"].isfinite().all(dim=1).logical_not().nonzero().tolist() == [[30]]


def test_the_cut_is_given_to_all_folders_with_what_it_is_of_before(job, monkeypatch):
    """It says that both are there, to whoever goes on after a kill."""
    jobs, linked = [job, replace(job, target=job.target.with_name("other.ply"))], []
    monkeypatch.setattr(plan, "_link", lambda file, new: linked.append(new.name))
    plan.claim(jobs, 2)
    plan.cut_for(jobs, 2)
    assert linked == [BASE, CUT]


def test_the_cut_needs_room_for_the_base_twice_and_for_once_where_it_is_cut(job, monkeypatch):
    size = next(job.base.checkpoint.rglob("*.ply")).stat().st_size
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=size * 3 // 2))
    with pytest.raises(OutputError, match=f"and the tiles take at least {2 * size:,}"):
        refuse(job, 2)
    cut_in_three(job)
    refuse(job, 3)


def test_files_of_the_web_are_converted_before_they_are_cut(tmp_path):
    rows = np.zeros(9, SPLAT_RECORD)
    rows["scale"] = 0.1
    rows.tofile(tmp_path / "my room.splat")
    with pytest.raises(SettingsError, match=r"convert it first \(splat-transform 'my room.splat' 'my room_plain.ply'\), or leave --tiles out"):
        find_splats(tmp_path / "my room.splat")
    tiny.model(9).save(tmp_path / "room.glb", provenance={})
    with pytest.raises(SettingsError, match=r"first \(load_model\('room.glb'\).save\(Path\('room_plain.ply'\), provenance={}\) in Python\)"):
        find_splats(tmp_path / "room.glb")


def test_anchors_cannot_be_cut(tmp_path, job):
    folder = anchor_checkpoints.write(tmp_path / "anchors")
    with pytest.raises(SettingsError, match="a checkpoint of scaffold cannot be cut into tiles"):
        adapt_in_tiles(replace(job, base=replace(job.base, checkpoint=folder)), 2)


def test_a_single_splat_is_not_told_to_take_fewer_tiles(job):
    """There are at least two tiles."""
    tiny.model(1).save(find_splats(job.base.checkpoint)[0].path, provenance={}, overwrite=True)
    with pytest.raises(CheckpointError, match="has 1 splat, which cannot be cut into 2 tiles; leave --tiles out"):
        adapt_in_tiles(job, 2)


def test_more_tiles_than_splats(job):
    with pytest.raises(CheckpointError, match="has 80 splats, which cannot be cut into 90 tiles"):
        adapt_in_tiles(job, 90)
    assert not work_folder(job.target).exists()  # so that fewer may be tried


def test_views_that_show_nothing_are_refused_and_leave_no_folder(job):
    """The corrected command is another request, which a folder of this one would refuse."""
    around = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0], dtype=torch.float64))
    views = [replace(view, viewmat=around @ view.viewmat) for view in tiny.cameras(3, width=20, height=16)]
    folder = tiny.folder(job.base.checkpoint.with_name("other"), views)
    with pytest.raises(SettingsError, match="none of 3 views shows a splat: the cameras seem to be of another scene"):
        adapt_in_tiles(replace(job, base=replace(job.base, cameras=folder / "cameras.json")), 2)
    assert not work_folder(job.target).exists()


def test_what_is_refused_after_the_cut_leaves_no_folder(job):
    views, backend = {"settings": job.settings | {"views": "test"}}, {"base": replace(job.base, backend="gsplat")}
    for changes, told in ((views, "there are no test views among the 3 cameras"), (backend, "gsplat")):
        with pytest.raises((SettingsError, BackendUnavailable), match=told):
            adapt_in_tiles(replace(job, **changes), 2)
        assert not work_folder(job.target).exists()


def test_validation_views_that_show_nothing_do_not_count(job, monkeypatch):
    """As without tiles."""
    around = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0], dtype=torch.float64))
    views = tiny.cameras(5, seed=3, width=20, height=16)
    away = [replace(view, viewmat=around @ view.viewmat) for view in views[:2]]
    monkeypatch.setattr("mipmap_plugin.adaptation.views.of_run.split_validation", lambda cameras, chosen, *_: (chosen, [*away, *views[2:]]))
    folder = work_folder(job.target)
    folder.mkdir()
    make_cut(job.base.checkpoint, 2, folder)
    found = opened(job.base, job.scale, None, job.config(), folder).views
    judged = torch.stack([view.viewmat for view in (*found.steering, *found.choosing)])
    assert torch.equal(judged, torch.stack([views[number].viewmat for number in (2, 4, 3)]))


def test_what_is_wrong_with_views_is_told(job, monkeypatch):
    monkeypatch.setattr("mipmap_plugin.adaptation.views.remarks.UNLIKE", 0.5)
    with pytest.warns(UserWarning, match="adapt with the cameras of each lens on their own"):
        adapt_in_tiles(replace(job, settings=job.settings | {"steps": 0}), 2)


def test_jobs_of_several_bases_or_of_one_output_are_refused(job, tmp_path):
    other = replace(job, target=job.target.with_name("other.ply"), base=replace(job.base, background="white"))
    for jobs in ([job, other], [job, replace(job, scale=0.25)]):
        with pytest.raises(SettingsError, match="those of one base, each with an output of its own"):
            next(adapt_all_in_tiles(jobs, 2))


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        ("a.ply b.ply --scale 1/2 --tiles 2", "--tiles cuts one checkpoint"),
        ("a.ply --scale 1/2 --tiles 2 --report", "without --tiles"),
        ("a.ply --scale 1/2 --tiles 2 --dask local:2 --send-files", "leave --send-files out"),
        ("a.ply --scale 1/2 --tiles 2 --jobs 0", "--jobs must be at least 1, got 0"),
    ],
)
def test_commands_that_cannot_be(words, reason, capsys):
    assert main(["adapt", *words.split()]) == 2
    assert reason in capsys.readouterr().err


@pytest.mark.parametrize("seed", [0, 5], ids=["its own scene", "another"])
def test_photographs_of_cameras_are_compared_with_the_whole_base(tmp_path, monkeypatch, recwarn, seed):
    """A sample of its splats shows next to nothing of them."""
    monkeypatch.setattr("mipmap_plugin.tiles.reading.SAMPLE", 3)
    base = Base(tiny.ply(tmp_path / "base.ply"), tiny.scene(tmp_path / "scene", train=tiny.cameras(4), seed=seed))
    adapt_in_tiles(Job(base, tmp_path / "out.ply", 0.5, recipe="instant"), 2)
    assert any("they may be of another scene" in str(warning.message) for warning in recwarn) == (seed == 5)
