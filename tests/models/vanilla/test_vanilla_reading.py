"""Plain 3DGS is read as stored, and its training's options with it."""

import json
import math

import numpy as np
import pytest
import tiny
import torch
from ply_files import splat_columns, splat_names, write, write_model_folder, write_splats
from vanilla_models import same

from mipmap_plugin.errors import CheckpointError
from mipmap_plugin.formats.cfg_args import read_cfg_args
from mipmap_plugin.models.base import TrainedScale
from mipmap_plugin.models.columns import OPACITY_MARGIN
from mipmap_plugin.models.reading import load_vanilla
from mipmap_plugin.wrap import wrap_model


def one_splat(path, **columns):
    zeros = {name: np.zeros(1, np.float32) for name in splat_names(0)}
    return write(path, {**zeros, **{name: np.float32([value]) for name, value in columns.items()}})


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


@pytest.mark.parametrize("form", ["binary_little_endian", "binary_big_endian", "ascii"])
def test_columns_of_16_bits_are_halves(tmp_path, form):
    """PLY has no type for these; exporters call them ushort (Babylon.js #18816)."""
    whole = load_vanilla(write_splats(tmp_path / "whole.ply"))
    halves = {name: column.astype(np.float16).view(np.uint16) for name, column in splat_columns(5).items()}
    model = load_vanilla(write(tmp_path / "a.ply", halves, form))
    assert model.notes == ["its columns have 16 bits, read as half-precision floats"] and not model.extras
    for name, tensor in whole.parameters().items():
        torch.testing.assert_close(model.parameters()[name], tensor.half().float(), rtol=0, atol=0)


@pytest.mark.parametrize("name", ["f_dc_1", "f_rest_3", "scale_2", "rot_0"])
def test_codes_in_place_of_values_are_refused(tmp_path, name):
    codes = {**splat_columns(5), name: np.arange(5, dtype=np.uint8)}
    with pytest.raises(CheckpointError, match=f"a.ply is quantized by .*: its column {name} holds whole numbers of 8 bits, .* export it again as fl"):
        load_vanilla(write(tmp_path / "a.ply", codes))


@pytest.mark.parametrize("full", [np.uint8(255), np.float32(1), np.float32(255)])
def test_rgb_stands_in_for_dc(tmp_path, full):
    columns = {name: column for name, column in splat_columns(2, 0).items() if not name.startswith("f_dc")}
    colors = {name: np.array([full, 0 * full], full.dtype) for name in ("red", "green", "blue")}
    model = load_vanilla(write(tmp_path / "a.ply", {**columns, **colors}))
    rendered_colors = 0.5 + 0.28209479177387814 * model.gaussians().sh[:, 0]
    torch.testing.assert_close(rendered_colors, torch.tensor([[1.0] * 3, [0.0] * 3]))
    assert model.notes == ["its colors are floats above 16, read as numbers in 0..255"] * bool(full == 255 and full.dtype == np.float32)


def test_an_infinite_color_does_not_make_all_colors_numbers_up_to_255(tmp_path):
    columns = {name: column for name, column in splat_columns(2, 0).items() if not name.startswith("f_dc")}
    colors = {name: np.array([np.inf, 0.5], np.float32) for name in ("red", "green", "blue")}
    model = load_vanilla(write(tmp_path / "a.ply", {**columns, **colors}))
    assert model.gaussians().sh[-1, 0].abs().max() < 1e-6


def test_refuses_other_f_rest_counts_and_missing_columns(tmp_path):
    columns = splat_columns(2)
    del columns["f_rest_44"]
    with pytest.raises(CheckpointError, match="44 f_rest columns, which fit no SH degree"):
        load_vanilla(write(tmp_path / "a.ply", columns))
    del columns["rot_3"]
    with pytest.raises(CheckpointError, match="lacks the columns rot_3"):
        load_vanilla(write(tmp_path / "a.ply", columns))


def test_trained_scale_from_cfg_args(tmp_path):
    model = load_vanilla(write_model_folder(tmp_path / "m"))
    assert model.trained == TrainedScale(resolution=4, background=(1.0, 1.0, 1.0))
    assert "cfg_args says SH degree 1, but the PLY holds degree 3" in model.notes[0]
    assert load_vanilla(write_splats(tmp_path / "alone.ply")).trained == TrainedScale()


@pytest.mark.parametrize("text", [b"\xef\xbb\xbfNamespace(%s)", b"Namespace(%s, source_path='C:\\\\J\xfcrgen')"], ids=["a mark", "another encoding"])
def test_cfg_args_of_windows_are_read_and_copied_byte_by_byte(tmp_path, text):
    """A letter in a path, or an editor's mark, took away the background and the test views, too."""
    folder, text = write_model_folder(tmp_path / "m"), text % b"sh_degree=3, white_background=True, resolution=2"
    (folder / "cfg_args").write_bytes(text)
    model = load_vanilla(folder)
    assert model.trained == TrainedScale(resolution=2, background=(1.0, 1.0, 1.0))
    model.save(tmp_path / "out", provenance={})
    assert (tmp_path / "out/cfg_args").read_bytes() == text


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
