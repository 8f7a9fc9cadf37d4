"""Files of a chosen size: the number of splats that fits, and the zoom that suits it."""

import json
import re
import zlib

import gltf_files
import pytest
import tiny
import torch

from mipmap_plugin import cli, load_model
from mipmap_plugin.commands.types import read_size
from mipmap_plugin.errors import OutputError, SettingsError
from mipmap_plugin.formats.ply import read_header
from mipmap_plugin.levels.fitting import ARCHIVE, UNKNOWN, fitting_scale, recorded, splats_within
from mipmap_plugin.models import contract
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.recipes import recipe, scale_of_fraction
from mipmap_plugin.wrap import wrap_model

# Bytes of a splat with SH of degree 1, in float32: a mean and a normal, 4 coefficients of 3 colors, an opacity, scales and a quaternion.
ROW = 4 * (3 + 3 + 12 + 1 + 3 + 4)


@pytest.mark.parametrize(("text", "size"), [("20MB", 20_000_000), ("1.5 GB", 1_500_000_000), ("64kib", 65_536), ("4000", 4000)])
def test_sizes_are_read(text, size):
    assert read_size(text) == size


@pytest.mark.parametrize("text", ["20 parsecs", "", "-3MB", "MB", "0", "1.2.3MB", "9" * 400])
def test_a_size_that_is_none_is_refused(text):
    with pytest.raises(SettingsError, match="bytes: must be a size such as 20MB"):
        read_size(text)


def test_what_a_format_cannot_hold_is_not_said_of_the_file_that_only_its_size_is_asked_of(recwarn):
    """It was said twice, of different numbers of splats."""
    assert splats_within(tiny.model(500, degree=4), 10**9, "a.glb", {}) == 500 and not recwarn.list


@pytest.mark.parametrize("scale", [0.05, 0.2, 0.39, 0.41, 0.6, 0.7])
def test_the_zoom_of_a_count_is_that_at_which_the_recipe_keeps_it(scale):
    assert scale_of_fraction(recipe("default", scale).merge_to) == pytest.approx(scale)


def test_as_many_splats_as_the_base_has_suit_its_own_scale():
    assert fitting_scale(200, tiny.model(60)) == fitting_scale(60, tiny.model(60)) == 1 > fitting_scale(59, tiny.model(60))


def test_as_many_splats_as_fit_into_a_file_do_fit(tmp_path):
    model, size, record = tiny.model(500), 40_000, {"settings": "x" * 3000}
    most = splats_within(model, size, "file.ply", record)
    for name in ("file.ply", "folder"):
        saved = tiny.model(most).save(tmp_path / name, provenance=record)
        assert size - UNKNOWN - ROW <= saved.stat().st_size <= size - UNKNOWN and splats_within(model, size, name, record) == most
    assert splats_within(model, 10**9, "file.ply", {}) == 500
    with pytest.raises(SettingsError, match="3,000 bytes have no room for a header and a splat"):
        splats_within(model, 3000, "file.ply", record)


class Own(VanillaModel):
    """Of a family that saves nothing but files of its own ending."""

    def save(self, path, *, provenance, overwrite=False):
        if path.suffix != ".own":
            raise OutputError(f"{path}: give a name that ends in .own")
        return super().save(path.with_suffix(".ply"), provenance=provenance, overwrite=overwrite).rename(path)


def test_files_of_a_third_party_family_are_measured_under_their_own_ending():
    model = Own(tiny.model(500).parameters())
    assert splats_within(model, 40_000, "file_x0.5.own", {}) == pytest.approx((40_000 - ARCHIVE) / ROW, rel=0.05)


def test_a_format_that_cannot_be_written_is_told_by_the_name_that_was_given(monkeypatch):
    monkeypatch.setattr("shutil.which", lambda *_, **__: None)
    with pytest.raises(SettingsError, match=r"^phone\.spz: this format takes splat-transform, which is not installed"):
        splats_within(tiny.model(), 10**6, "phone.spz", {})


def test_what_is_written_for_a_viewer_is_measured_in_the_format_of_that(tmp_path):
    """A PLY for one that reads no glTF, which has fewer bytes for each splat."""
    base, size = tmp_path / "base.glb", 6_000
    gltf_files.glb(base, tiny.gaussians(60))
    assert cli.main(["adapt", str(base), "--bytes", str(size), "--viewer", "spark", "--viewer", "three", "--recipe", "instant", "--scale", "1"]) == 0
    assert [file.stat().st_size <= size for file in sorted(tmp_path.glob("base_*_*[!n]"))] == [True, True]


@pytest.mark.parametrize("size", [4_000, 9_000])
def test_a_small_glb_is_as_large_as_it_may_be_and_no_larger(tmp_path, size):
    """Its head has as many bytes as tens of splats."""
    tiny.model(500, degree=0).save(tmp_path / "base.ply", provenance={})
    words = ["adapt", str(tmp_path / "base.ply"), "--bytes", str(size), "--recipe", "instant", "--scale", "1/2"]
    assert cli.main([*words, "--output", str(tmp_path / "small.glb")]) == 0
    assert size - 500 <= (tmp_path / "small.glb").stat().st_size <= size


OPTIONS = [[], ["--viewer", "spark"], ["--viewer", "mip"], ["--scale", "1/3"], ["--viewer", "portable", "--recipe", "thorough"]]


@pytest.mark.parametrize("options", OPTIONS)
def test_a_file_is_as_large_as_it_may_be_and_no_larger(tmp_path, options):
    base, output, size = tiny.folder(tmp_path / "base", tiny.cameras(2, width=16, height=12)), tmp_path / "small.ply", 6_000
    words = ["adapt", str(base), "--bytes", str(size), "--output", str(output), "--steps", "1", "--views", "given"]
    assert cli.main([*words, *options]) == 0
    assert size - UNKNOWN - 2 * read_header(output).vertex.stride <= output.stat().st_size <= size


def test_what_is_recorded_of_a_network_is_known_before_the_run(tmp_path):
    """Its hash was no part of the header that room was left for: with that of photographs it had more bytes than were kept for the unknown."""
    (network := tmp_path / "net.pth").write_bytes(b"weights")
    base, settings = wrap_model(tiny.model(), cameras=tiny.cameras(2)), {"recipe": "instant", "upsampler": str(network)}
    with pytest.warns(UserWarning, match="is not used"):
        report = base.adapt(2, **settings).report
    assert recorded(base, [(2.0, None)], settings)["inputs"] == report.inputs


def test_a_file_of_fewer_splats_at_the_bases_own_scale_is_optimized():
    assert recipe("default", 1.0, most_splats=5).rates.means > 0


def test_the_command_makes_a_file_of_so_many_splats(tmp_path, capsys):
    base, output = tiny.folder(tmp_path / "base", tiny.cameras(2, width=16, height=12)), tmp_path / "small.ply"
    words = ["adapt", str(base), "--splats", "9", "--output", str(output), "--steps", "1", "--views", "given"]
    assert cli.main(words) == 0
    assert len(load_model(output)) <= 9
    assert "x0.1875" in capsys.readouterr().out  # 9 of 60 splats are those of 0.8 times this scale
    assert cli.main([*words[:-2], "--bytes", "1 parsec"]) == 2 and "such as 20MB" in capsys.readouterr().err
    assert cli.main(["adapt", str(base)]) == 2 and "--scale" in capsys.readouterr().err


def test_a_file_of_few_splats_is_compared_with_the_base(tmp_path, capsys):
    """Which it may not be replaced by, for that has more."""
    base, output = tiny.folder(tmp_path / "base", tiny.cameras(4, width=16, height=12)), tmp_path / "small.ply"
    words = ["adapt", str(base), "--splats", "5", "--scale", "1", "--output", str(output), "--steps", "1", "--json"]
    assert cli.main(words) == 0
    [report] = json.loads(capsys.readouterr().out)
    assert report["gaussians_after"] <= 5 and report["validation"]["the base as it is"] > max(
        psnr for state, psnr in report["validation"].items() if state != "the base as it is"
    )
    assert cli.main([*words[:-1], "--overwrite"]) == 0
    before, after = re.search(r"x1: ([0-9.]+) -> ([0-9.]+) dB", capsys.readouterr().out).groups()
    assert float(before) > float(after)


def test_what_a_format_rounded_counts_as_it_will_be_written(tmp_path, monkeypatch):
    """A base out of a compressed file compresses better than what is made of it."""

    def save(model, path, record):
        path.write_bytes(zlib.compress((model.parameters()["shN"].detach() * 128).round().to(torch.int8).numpy().tobytes()))
        return path

    monkeypatch.setattr(contract, "save", save)
    fine = tiny.model(3000, degree=3)
    coarse = VanillaModel({**fine.parameters(), "shN": (16 * fine.parameters()["shN"]).round() / 16})
    most = splats_within(coarse, 40_000, "phone.spz", {})
    kept = fine.keep_rows(torch.arange(3000) < most)
    assert 30_000 < save(kept, tmp_path / "a.spz", {}).stat().st_size <= 40_000
