"""Vanilla 3DGS: read as stored, activated as 3DGS does, written so that 3DGS reads it, and never damaged on the way."""

import hashlib
import json
import math

import numpy as np
import pytest
import tiny
import torch
from ply_files import splat_columns, splat_names, write, write_model_folder, write_splats

from mipmap_plugin.errors import CheckpointError, OutputExists, SettingsError, ShapeError
from mipmap_plugin.formats.cfg_args import read_cfg_args
from mipmap_plugin.formats.ply import read_ply
from mipmap_plugin.formats.tags import provenance_of, with_tags
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.models import load_model
from mipmap_plugin.models.base import TrainedScale
from mipmap_plugin.models.columns import OPACITY_MARGIN
from mipmap_plugin.models.raw import MIN_SCALE
from mipmap_plugin.models.reading import load_vanilla
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.splatting.rotations import unit_quaternions
from mipmap_plugin.wrap import wrap_model

PROVENANCE = {"scale": 0.25, "settings": {"steps": 500}}
SHAPES = {"means": (3,), "scales": (3,), "quats": (4,), "opacities": (), "sh0": (1, 3), "shN": (15, 3)}


def raw_model(count: int = 4) -> VanillaModel:
    torch.manual_seed(0)
    return VanillaModel({name: torch.randn(count, *shape) for name, shape in SHAPES.items()})


def same(a: VanillaModel, b: VanillaModel) -> bool:
    """Bit for bit."""
    return all(torch.equal(x.view(torch.int32), y.view(torch.int32)) for x, y in zip(a.parameters().values(), b.parameters().values(), strict=True))


def one_splat(path, **columns):
    zeros = {name: np.zeros(1, np.float32) for name in splat_names(0)}
    return write(path, {**zeros, **{name: np.float32([value]) for name, value in columns.items()}})


# Reading


def test_activation_of_a_known_splat(tmp_path):
    log = dict(zip(("scale_0", "scale_1", "scale_2"), np.log([0.2, 0.1, 0.05]), strict=True))
    rest = {"rot_0": 1, "rot_1": 0.5, "rot_2": -0.5, "rot_3": 0.25, "opacity": 1, "f_dc_0": 0.5, "f_dc_1": -0.3, "f_dc_2": 0.1}
    path = one_splat(tmp_path / "a.ply", x=0.1, y=0.2, z=0.3, **rest, **log)
    splat = load_vanilla(path).gaussians()
    quat = np.array([1, 0.5, -0.5, 0.25]) / math.sqrt(1.5625)
    expected = {"means": [0.1, 0.2, 0.3], "scales": [0.2, 0.1, 0.05], "quats": quat, "opacities": 0.731058579, "sh": [[0.5, -0.3, 0.1]]}
    for name, value in expected.items():
        np.testing.assert_allclose(getattr(splat, name)[0], value, rtol=1e-6)


@pytest.mark.parametrize("degree", range(5))
def test_sh_of_every_degree_is_channel_major_in_the_file(tmp_path, degree):
    bands = (degree + 1) ** 2 - 1
    columns = splat_columns(3, bands)
    model = load_vanilla(write(tmp_path / "a.ply", columns))
    assert model.sh_degree == degree
    assert model.parameters()["shN"].shape == (3, bands, 3)
    for j in range(bands):
        for c in range(3):
            np.testing.assert_array_equal(model.gaussians().sh[:, 1 + j, c], columns[f"f_rest_{c * bands + j}"])


def test_columns_in_any_order_and_without_normals(tmp_path):
    columns = splat_columns(6)
    straight = load_vanilla(write(tmp_path / "a.ply", columns))
    shuffled = {name: columns[name] for name in sorted(columns) if not name.startswith("n")}
    assert same(load_vanilla(write(tmp_path / "b.ply", shuffled)), straight)


def test_double_columns_beyond_float32_are_dropped_not_spread(tmp_path):
    columns = {name: column.astype(np.float64) for name, column in splat_columns(3, 0).items()}
    columns["x"][1] = 1e300
    assert len(load_vanilla(write(tmp_path / "a.ply", columns))) == 2

@pytest.mark.parametrize("full", [np.uint8(255), np.uint16(65535)])
def test_opacities_that_are_whole_numbers_are_fractions_and_no_logits(tmp_path, full):
    path = write(tmp_path / "a.ply", {**splat_columns(3), "opacity": np.array([0, full // 5, full], full.dtype)})
    model = load_vanilla(path)
    torch.testing.assert_close(model.gaussians().opacities, torch.tensor([OPACITY_MARGIN, 0.2, 1 - OPACITY_MARGIN]))
    assert f"its opacities are whole numbers ({full.dtype}), read as fractions of the largest" in model.notes
    assert "opacity" not in model.extras



@pytest.mark.parametrize("full", [np.uint8(255), np.float32(1)])
def test_rgb_stands_in_for_dc(tmp_path, full):
    columns = {name: column for name, column in splat_columns(2, 0).items() if not name.startswith("f_dc")}
    colors = {name: np.array([full, 0 * full], full.dtype) for name in ("red", "green", "blue")}
    model = load_vanilla(write(tmp_path / "a.ply", {**columns, **colors}))
    rendered_colors = 0.5 + 0.28209479177387814 * model.gaussians().sh[:, 0]
    torch.testing.assert_close(rendered_colors, torch.tensor([[1.0] * 3, [0.0] * 3]))
    assert not model.notes


def test_refuses_other_f_rest_counts_and_missing_columns(tmp_path):
    columns = splat_columns(2)
    del columns["f_rest_44"]
    with pytest.raises(CheckpointError, match="44 f_rest columns, which fit no SH degree"):
        load_vanilla(write(tmp_path / "a.ply", columns))
    del columns["rot_3"]
    with pytest.raises(CheckpointError, match="lacks the columns rot_3"):
        load_vanilla(write(tmp_path / "a.ply", columns))


def test_source_and_digest(tmp_path):
    path = write_splats(tmp_path / "a.ply")
    model = load_vanilla(path)
    assert (model.source, model.digest) == (path, hashlib.sha256(path.read_bytes()).hexdigest())


def test_trained_scale_from_cfg_args(tmp_path):
    model = load_vanilla(write_model_folder(tmp_path / "m"))
    assert model.trained == TrainedScale(resolution=4, background=(1.0, 1.0, 1.0))
    assert "cfg_args says SH degree 1, but the PLY holds degree 3" in model.notes[0]
    assert load_vanilla(write_splats(tmp_path / "alone.ply")).trained == TrainedScale()


def test_a_model_with_hostile_cfg_args_loads_without_them(tmp_path):
    folder = write_model_folder(tmp_path / "m", cfg_args="print('no')")
    model = load_vanilla(folder)
    assert model.trained == TrainedScale()
    assert "is not executed" in model.notes[0]
    model.save(tmp_path / "out", provenance={})
    assert read_cfg_args(tmp_path / "out/cfg_args")["sh_degree"] == 3


@pytest.mark.parametrize(
    ("comments", "screen_filter"),
    [
        (("SplatRenderMode: mip",), "antialiased"),
        (("antialiased 1",), "antialiased"),
        (("SplatRenderMode: mip", "antialiased 0"), "classic"),
        (("SplatRenderMode: unheard",), "classic"),
        ((), "classic"),
    ],
)
def test_header_tag_names_the_screen_filter(tmp_path, comments, screen_filter):
    model = load_vanilla(write_splats(tmp_path / "a.ply", comments=comments))
    assert model.trained.screen_filter == screen_filter


@pytest.mark.parametrize(("name", "eps2d"), [("analytic", 0.0), ("window", 0.0), ("mip", 0.1), ("antialiased", 0.3), ("classic", 0.3)])
@pytest.mark.parametrize("target", ["made.ply", "made"])
def test_the_screen_filter_that_a_user_names_is_that_of_the_adapted_file(tmp_path, name, eps2d, target):
    base = wrap_model(write_splats(tmp_path / "a.ply"), cameras=tiny.cameras(1), screen_filter=name, backend="reference")
    base.adapt(1 / 2, recipe="instant").save(tmp_path / target)
    again = load_vanilla(tmp_path / target)
    assert (again.trained.screen_filter, again.trained.eps2d) == (name, eps2d)
    assert any(f"the header says that the splats are to be drawn {name} ({eps2d:g} px²)" in note for note in again.notes)


@pytest.mark.parametrize("record", ['{"screen_filter": [], "kernel_size": 0.1}', '{"screen_filter": "unheard", "kernel_size": 0}', "[]", "{"])
def test_a_record_that_names_no_filter_is_passed_over(tmp_path, record):
    model = load_vanilla(write_splats(tmp_path / "a.ply", comments=(f"mipmap_plugin {record}",)))
    assert (model.trained.screen_filter, model.trained.eps2d) == ("classic", 0.3)


def test_notes_describe_the_exposure(tmp_path):
    folder = write_model_folder(tmp_path / "m", cfg_args="Namespace(sh_degree=3, train_test_exp=True)")
    identity = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]
    for content, note in {
        json.dumps({"a": identity}): "only identities",
        json.dumps({"a": identity, "b": [[2, 0, 0, 0], *identity[1:]]}): "changes 1 of 2 images",
        "[]": "cannot be read",
    }.items():
        (folder / "exposure.json").write_text(content)
        notes = load_vanilla(folder).notes
        assert "train_test_exp" in notes[0]
        assert note in notes[1]


# The model


def test_base_is_frozen_and_a_copy_is_independent():
    base = raw_model()
    before = {name: tensor.clone() for name, tensor in base.parameters().items()}
    copy = base.copy()
    assert all(tensor.is_leaf and tensor.requires_grad for tensor in copy.parameters().values())
    copy.reshape(lambda _: (torch.ones(4, 3), torch.zeros(4)))
    copy.notes.append("changed")
    assert not any(tensor.requires_grad for tensor in base.parameters().values())
    assert all(torch.equal(tensor, before[name]) for name, tensor in base.parameters().items())
    assert base.notes == []


def test_gradients_reach_every_parameter():
    model = raw_model().copy()
    splats = model.gaussians()
    sum(getattr(splats, name).square().sum() + getattr(splats, name).sum() for name in ("means", "quats", "scales", "opacities", "sh")).backward()
    assert all(tensor.grad.isfinite().all() and tensor.grad.any() for tensor in model.parameters().values())


def test_quaternion_gradient_is_exact():
    torch.manual_seed(0)
    quats = (torch.randn(5, 4, dtype=torch.float64) * torch.tensor([[0.01], [1], [3], [20], [100]])).requires_grad_()
    assert torch.autograd.gradcheck(unit_quaternions, quats)


@pytest.mark.parametrize("size", [0.0, 1e-42, 1e-16, 1e-15, 0.003, 1.0, 1e30])
def test_quaternions_of_any_size_are_safe(size):
    quats = (size * torch.tensor([[0.0, 3.0, 0.0, 4.0]])).requires_grad_()
    unit = unit_quaternions(quats)
    unit.sum().backward()
    torch.testing.assert_close(unit.detach(), torch.tensor([[0.0, 0.6, 0.0, 0.8]] if size > 1e-16 else [[1.0, 0.0, 0.0, 0.0]]))
    assert quats.grad.isfinite().all()


def test_legal_extremes_activate_to_finite_values_and_gradients(tmp_path):
    columns = splat_columns(6, 0)
    columns["opacity"][:4] = [80, -80, np.inf, -np.inf]
    columns["scale_0"][4:] = [-np.inf, -90]
    model = load_vanilla(write(tmp_path / "a.ply", columns)).copy()
    assert len(model) == 6
    splats = model.gaussians()
    torch.testing.assert_close(splats.opacities[:4].detach(), torch.tensor([1.0, 0, 1, 0]))
    (splats.opacities.sum() + splats.scales.sum()).backward()
    assert all(tensor.grad is None or tensor.grad.isfinite().all() for tensor in model.parameters().values())


def test_from_gaussians_activates_to_the_same():
    splats = raw_model(50).gaussians()
    again = VanillaModel.from_gaussians(splats).gaussians()
    for name in ("means", "quats", "scales", "opacities", "sh"):
        torch.testing.assert_close(getattr(again, name), getattr(splats, name))


def test_from_gaussians_refuses_covariances():
    splats = raw_model(1).gaussians()
    with pytest.raises(SettingsError, match="covariances"):
        VanillaModel.from_gaussians(Gaussians(splats.means, splats.quats, splats.scales, splats.opacities, splats.sh, torch.eye(3)[None]))


def test_reshape_keeps_leaves_and_stays_finite_at_the_ends():
    model = raw_model(3).copy()
    leaf = model.parameters()["scales"]
    model.reshape(lambda _: (torch.tensor([[0.0, 1.0, 2.0]] * 3), torch.tensor([0.0, 0.5, 1.0])))
    splats = model.gaussians()
    assert model.parameters()["scales"] is leaf
    assert leaf.isfinite().all() and model.parameters()["opacities"].isfinite().all()
    torch.testing.assert_close(splats.scales[0].detach(), torch.tensor([MIN_SCALE, 1.0, 2.0]))
    torch.testing.assert_close(splats.opacities.detach(), torch.tensor([OPACITY_MARGIN, 0.5, 1 - OPACITY_MARGIN]))
    with pytest.raises(ShapeError, match="scales: expected shape"):
        model.reshape(lambda _: (torch.ones(1, 3), torch.ones(3)))


def test_shapes_are_checked():
    raw = raw_model().parameters()
    for broken, sentence in {
        "quats": ({**raw, "quats": raw["quats"][:2]}, "quats: expected shape"),
        "shN": ({**raw, "shN": raw["shN"][:, :7]}, "7 coefficients fit no SH degree"),
        "missing": ({"means": raw["means"]}, "expected means, scales"),
    }.values():
        with pytest.raises(ShapeError, match=sentence):
            VanillaModel(broken)


def test_to_is_a_copy():
    model = raw_model().copy()
    moved = model.to("cpu")
    assert same(moved, model)
    assert all(tensor.requires_grad and tensor.is_leaf for tensor in moved.parameters().values())
    assert moved.parameters()["means"].data_ptr() != model.parameters()["means"].data_ptr()


def test_row_opacities():
    model = raw_model().copy()
    torch.testing.assert_close(model.row_opacities(), model.gaussians().opacities.detach())
    assert not model.row_opacities().requires_grad


# Writing


@pytest.mark.parametrize("degree", range(5))
def test_round_trip_is_bit_exact(tmp_path, degree):
    first = load_vanilla(write_splats(tmp_path / "a.ply", 20, (degree + 1) ** 2 - 1))
    second = load_vanilla(first.save(tmp_path / "b.ply", provenance=PROVENANCE))
    assert same(first, second)


def test_written_columns_are_those_of_3dgs(tmp_path):
    file = read_ply(raw_model().save(tmp_path / "a.ply", provenance={}))
    assert list(file.columns) == splat_names(15)
    assert {column.dtype.str for column in file.columns.values()} == {"<f4"}
    assert file.format == "binary_little_endian"
    assert not any(file.columns[name].any() for name in ("nx", "ny", "nz"))


def test_header_keeps_foreign_comments_and_replaces_those_of_this_package(tmp_path):
    model = load_vanilla(write_splats(tmp_path / "a.ply", comments=("Exported from Brush", "SplatRenderMode: mip", "antialiased 1")))
    once = load_vanilla(model.save(tmp_path / "b.ply", provenance={"scale": 2}))
    comments = read_ply(once.save(tmp_path / "c.ply", provenance={**PROVENANCE, "name": "Brüder\n"})).comments
    assert comments[:4] == ("Exported from Brush", "mip=true", "kernel_size=0.3", "SplatRenderMode: mip")
    assert len(comments) == 5 and comments[4].isascii()
    assert provenance_of(comments) == {**PROVENANCE, "name": "Brüder\n"}


def test_header_says_default_for_the_classic_filter(tmp_path):
    assert "SplatRenderMode: default" in read_ply(raw_model().save(tmp_path / "a.ply", provenance={})).comments


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
    with pytest.raises(CheckpointError, match="none of its 1 splats is finite"):
        load_model(shared_data / "checkpoints/fixtures/nan-opacity-binary-le.ply")
