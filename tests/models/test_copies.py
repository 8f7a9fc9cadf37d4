"""Copies have no digest of a file; a report of adapting one names the digest of its parameters."""

import anchor_checkpoints
import mip_checkpoints
import moving
import pytest
import tiny

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
