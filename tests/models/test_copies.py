"""Copies have no digest of a file; a report of adapting one names the digest of its parameters."""

import zipfile

import anchor_checkpoints
import mip_checkpoints
import moving
import pytest
import tiny
import torch

from mipmap_plugin.models import load_model
from mipmap_plugin.wrap import wrap_model

WRITERS = {"3dgs": tiny.folder, "mip": mip_checkpoints.folder, "scaffold": anchor_checkpoints.write, "deformable": moving.write_deformable}


@pytest.mark.parametrize("family", WRITERS)
def test_a_copy_has_no_digest_and_another_device_has_it(tmp_path, family):
    WRITERS[family](tmp_path / "m")
    model = load_model(tmp_path / "m")
    assert len(model.digest) == 64 and model.to("cpu").digest == model.digest
    assert model.copy().digest == model.copy().copy().digest == ""


def test_a_report_names_the_base_that_was_adapted(tmp_path):
    file = tiny.ply(tmp_path / "base.ply")
    first = wrap_model(file, cameras=tiny.cameras()).adapt(0.5, recipe="instant")
    second = wrap_model(first.model, cameras=tiny.cameras()).adapt(0.5, recipe="instant")
    again = wrap_model(first.model, cameras=tiny.cameras()).adapt(0.5, recipe="instant")
    assert first.report.base == load_model(file).digest
    assert len(second.report.base) == 64 and second.report.base != first.report.base
    assert second.report.base == again.report.base


@pytest.mark.parametrize("write", [anchor_checkpoints.write, moving.write_deformable, moving.write_hexplane])
def test_networks_beside_the_splats_count_in_the_digest(tmp_path, write):
    """Else other networks beside an unchanged PLY would count as adapted already."""
    write(tmp_path)
    before = load_model(tmp_path).digest
    network = next(each for each in sorted(tmp_path.rglob("*")) if each.suffix in {".pt", ".pth"})
    if network.suffix == ".pt":  # an archive, which may have a comment
        with zipfile.ZipFile(network, "a") as archive:
            archive.comment = b"other"
    else:
        torch.save({name: tensor + 1e-3 for name, tensor in torch.load(network, weights_only=True).items()}, network)
    assert load_model(tmp_path).digest != before
