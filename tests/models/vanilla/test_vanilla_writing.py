"""Plain 3DGS is written so that its readers find what they look for, and survives a round trip."""

import numpy as np
import pytest
from ply_files import splat_columns, splat_names, write, write_model_folder, write_splats
from vanilla_models import raw_model, same

from mipmap_plugin.errors import CheckpointError, OutputExists
from mipmap_plugin.formats.cfg_args import read_cfg_args
from mipmap_plugin.formats.ply import read_header, read_ply
from mipmap_plugin.formats.tags import provenance_of, recorded_filter, with_tags
from mipmap_plugin.models import load_model
from mipmap_plugin.models.adapted_scale import adapted_scale
from mipmap_plugin.models.base import TrainedScale
from mipmap_plugin.models.reading import load_vanilla

PROVENANCE = {"scale": 0.25, "settings": {"steps": 500}}


# Writing


@pytest.mark.parametrize("degree", range(5))
def test_round_trip_is_bit_exact(tmp_path, degree):
    first = load_vanilla(write_splats(tmp_path / "a.ply", 20, (degree + 1) ** 2 - 1))
    second = load_vanilla(first.save(tmp_path / "b.ply", provenance=PROVENANCE))
    assert same(first, second)


def test_written_columns_are_those_of_3dgs(tmp_path):
    columns = read_ply(raw_model().save(tmp_path / "a.ply", provenance={})).columns
    assert list(columns) == splat_names(15)
    assert {column.dtype.str for column in columns.values()} == {"<f4"}
    assert not any(columns[name].any() for name in ("nx", "ny", "nz"))
    assert read_header(tmp_path / "a.ply").format == "binary_little_endian"


def test_header_keeps_foreign_comments_and_replaces_those_of_this_package(tmp_path):
    model = load_vanilla(write_splats(tmp_path / "a.ply", comments=("Exported from Brush", "SplatRenderMode: mip", "antialiased 1")))
    once = load_vanilla(model.save(tmp_path / "b.ply", provenance={"scale": 2}))
    comments = read_ply(once.save(tmp_path / "c.ply", provenance={**PROVENANCE, "name": "Brüder\n"})).comments
    assert comments[:4] == ("Exported from Brush", "mip=true", "kernel_size=0.3", "SplatRenderMode: mip")
    assert len(comments) == 5 and comments[4].isascii()
    assert provenance_of(comments) == {**PROVENANCE, "name": "Brüder\n"}


@pytest.mark.parametrize("digits", [400, 5000])  # more than a float holds, and than Python reads
def test_records_with_absurd_numbers_count_as_none(tmp_path, digits):
    huge = "9" * digits
    record = f'mipmap_plugin {{"scale": {huge}, "screen_filter": "analytic", "kernel_size": {huge}}}'
    file = write_splats(tmp_path / "a.ply", comments=(record,))
    assert adapted_scale(file) is None and recorded_filter([record]) is None
    assert load_vanilla(file).trained.screen_filter == "classic"


@pytest.mark.parametrize(("screen_filter", "eps2d", "compensates"), [("classic", 0.075, False), ("mip", 0.1, True), ("analytic", 0.3, False)])
def test_web_splat_reads_the_filter_in_its_own_words(screen_filter, eps2d, compensates):
    """It takes the first comment in which each word is, and refuses a file where what follows the last = there is no truth value, or number."""
    comments = with_tags(with_tags([], "antialiased", {}, 0.3), screen_filter, {"viewer": "spark"}, eps2d)
    first = {word: next(text for text in comments if word in text).split("=")[-1] for word in ("mip", "kernel_size")}
    assert first == {"mip": str(compensates).lower(), "kernel_size": f"{eps2d:g}"}
    assert sum("mip=" in text for text in comments) == 1


def test_extra_columns_are_kept_until_rows_change(tmp_path):
    segment = np.arange(5, dtype=np.int32)
    model = load_vanilla(write(tmp_path / "a.ply", {"segment": segment, **splat_columns(5)}))
    assert model.notes == ["extra columns are carried along: segment"]
    adapted = model.copy()
    file = read_ply(adapted.save(tmp_path / "b.ply", provenance={}))
    assert list(file.columns) == [*splat_names(15), "segment"]
    np.testing.assert_array_equal(file.columns["segment"], segment)
    adapted.replace_parameters({name: tensor[:3] for name, tensor in adapted.parameters().items()})
    assert "segment are dropped" in adapted.notes[-1]
    assert "segment" not in read_ply(adapted.save(tmp_path / "c.ply", provenance={})).columns


def test_a_second_set_of_colors_is_left_out(tmp_path):
    """Spark draws a cloud of points where a file has red, green and blue, Brush prefers them, and gsplat.js refuses columns of bytes."""
    colors = {name: np.arange(5, dtype=np.uint8) for name in ("red", "green", "blue", "alpha")}
    model = load_vanilla(write(tmp_path / "a.ply", splat_columns(5) | colors))
    assert not model.extras and model.notes[0].startswith("its columns red, green and blue are left out")
    assert list(read_ply(model.save(tmp_path / "b.ply", provenance={})).columns) == splat_names(15)


def test_normals_are_kept_until_rows_change_where_there_are_any(tmp_path):
    normals = {"nx": np.full(5, 0.6, np.float32), "nz": np.full(5, 0.8, np.float32)}
    model = load_vanilla(write(tmp_path / "a.ply", splat_columns(5) | normals))
    assert model.notes == ["extra columns are carried along: nx, ny, nz"]
    adapted = model.copy()
    file = read_ply(adapted.save(tmp_path / "b.ply", provenance={}))
    assert list(file.columns) == splat_names(15) and all((file.columns[name] == column).all() for name, column in normals.items())
    adapted.replace_parameters({name: tensor[:3] for name, tensor in adapted.parameters().items()})
    assert not read_ply(adapted.save(tmp_path / "c.ply", provenance={})).columns["nx"].any()


def test_model_folder_round_trip(tmp_path):
    options = "Namespace(sh_degree=3, source_path='C:\\\\a', resolution=8,  white_background=False)"
    folder = write_model_folder(tmp_path / "m", 7000, options)
    model = load_model(folder)
    saved = model.save(tmp_path / "out", provenance=PROVENANCE)
    assert saved == tmp_path / "out/point_cloud/iteration_7000/point_cloud.ply"
    assert (tmp_path / "out/cfg_args").read_text() == options
    assert (tmp_path / "out/cameras.json").read_bytes() == (folder / "cameras.json").read_bytes()
    again = load_model(tmp_path / "out")
    assert same(again, model) and again.trained == model.trained
    assert sorted(path.name for path in tmp_path.iterdir()) == ["m", "out"]


def test_cfg_args_follow_the_sh_degree_of_the_ply(tmp_path):
    load_vanilla(write_model_folder(tmp_path / "m")).save(tmp_path / "out", provenance={})
    options = read_cfg_args(tmp_path / "out/cfg_args")
    assert (options["sh_degree"], options["resolution"], options["white_background"]) == (3, 4, True)


@pytest.mark.parametrize(("options", "held_out"), [(None, None), ("Namespace(eval=True)", True), ("Namespace(eval=False)", False)])
def test_whether_views_were_held_out_is_as_unknown_as_before(tmp_path, options, held_out):
    """The original asks for the option; None is no --eval to it, and unknown here: a False would say that the base was trained on all views."""
    folder = write_model_folder(tmp_path / "m")
    (folder / "cfg_args").write_text(options) if options else (folder / "cfg_args").unlink()
    load_vanilla(folder).save(tmp_path / "out", provenance={})
    assert read_cfg_args(tmp_path / "out/cfg_args")["eval"] is held_out


@pytest.mark.parametrize("iteration", [None, 0])
def test_folder_of_a_model_without_an_iteration(tmp_path, iteration):
    model = raw_model() if iteration is None else load_vanilla(write_model_folder(tmp_path / "m", iteration))
    assert model.save(tmp_path / "out", provenance={}).parent.name == "iteration_30000"
    assert read_cfg_args(tmp_path / "out/cfg_args")["sh_degree"] == 3


def test_only_a_model_folder_is_replaced_and_only_with_the_option(tmp_path):
    old, new = raw_model(2), raw_model(3)
    old.save(tmp_path / "out", provenance={})
    with pytest.raises(OutputExists, match="--overwrite"):
        new.save(tmp_path / "out", provenance={})
    assert len(load_model(tmp_path / "out")) == 2
    (tmp_path / "out/.DS_Store").touch()
    new.save(tmp_path / "out", provenance={}, overwrite=True)
    assert len(load_model(tmp_path / "out")) == 3
    (tmp_path / "out/notes").mkdir()
    (tmp_path / "out/notes/mine.txt").touch()
    with pytest.raises(OutputExists, match=r"has other things in it, such as notes/mine.txt"):
        new.save(tmp_path / "out", provenance={}, overwrite=True)
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos/1.jpg").touch()
    with pytest.raises(OutputExists, match="other things in it"):
        new.save(tmp_path / "photos", provenance={}, overwrite=True)
    with pytest.raises(OutputExists, match="is a file"):
        new.save(tmp_path / "photos/1.jpg", provenance={}, overwrite=True)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out", "photos"]


def test_a_trained_model_is_not_replaced_even_with_the_option(tmp_path):
    folder = write_model_folder(tmp_path / "trained")
    with pytest.raises(OutputExists, match="holds a trained model, which --overwrite would delete"):
        raw_model().save(folder, provenance={}, overwrite=True)
    assert load_model(folder).source.exists()


# Real files


REAL = {
    "bases/chair_100": (16_874, 3),
    "bases/chair_400": (26_159, 3),
    "bases/lego_100": (23_415, 3),
    "bases/lego_200": (39_136, 3),
    "flowers_r8": (38_347, 3),
    "vanilla_iter7000": (9_080, 3),
    "yashica-t4": (8_192, 3),
    "donut_mip_fused": (45_624, 0),
    "lod_tiles/lod2_tile_0.ply": (6_831, 3),
    "lod_tiles/lod3_tile_0.ply": (1_971, 3),
    "lod_tiles/lod4_tile_0.ply": (489, 3),
    "lod_tiles/lod5_tile_0.ply": (111, 3),
    "fixtures/degree-1-sh.ply": (1, 1),
    "fixtures/degree-2-sh.ply": (1, 2),
    "fixtures/degree-3-sh.ply": (1, 3),
    "fixtures/one-gaussian-ascii.ply": (1, 0),
    "fixtures/one-gaussian-binary-le.ply": (1, 0),
    "fixtures/three-gaussian-binary-le.ply": (3, 1),
}


@pytest.mark.parametrize("name", REAL)
def test_real_checkpoints_survive_a_round_trip(shared_data, tmp_path, name):
    model = load_model(shared_data / "checkpoints" / name)
    assert (len(model), model.sh_degree) == REAL[name]
    splats = model.gaussians()
    assert all(getattr(splats, field).isfinite().all() for field in ("means", "quats", "scales", "opacities", "sh"))
    assert same(load_model(model.save(tmp_path / "out", provenance=PROVENANCE)), model)


def test_real_training_options(shared_data):
    assert load_model(shared_data / "checkpoints/flowers_r8").trained == TrainedScale(resolution=8, background=(0.0, 0.0, 0.0))
    assert load_model(shared_data / "checkpoints/bases/lego_100").trained == TrainedScale(resolution=-1, background=(1.0, 1.0, 1.0))


def test_real_file_of_nothing_but_nan_is_refused(shared_data):
    with pytest.raises(CheckpointError, match="none of 1 splat is finite"):
        load_model(shared_data / "checkpoints/fixtures/nan-opacity-binary-le.ply")
