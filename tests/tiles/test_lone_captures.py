"""A capture that came without cameras, in tiles."""

import pytest
import torch
from lone_capture import capture

from mipmap_plugin.cli import main
from mipmap_plugin.models.adapted_scale import adapted_orbit
from mipmap_plugin.models.vanilla import VanillaModel


@pytest.mark.usefixtures("few_views")
@pytest.mark.filterwarnings("ignore:no ")
def test_its_colors_tell_from_where_it_was_photographed_in_tiles_too(tmp_path):
    splats = capture().to(dtype=torch.float32)
    base, file = VanillaModel.from_gaussians(splats).save(tmp_path / "base.ply", provenance={}), tmp_path / "adapted.ply"
    words = ["--recipe", "instant", "--scale", "1/8", "--output", str(file), "--tiles", "2"]
    assert main(["adapt", str(base), *words]) == 0
    assert (adapted_orbit(file) or {}).get("seen")
