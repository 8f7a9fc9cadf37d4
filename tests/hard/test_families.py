"""Every family of checkpoints with hard rows among ordinary ones: splats, image and gradients are finite, or the file is refused."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tiny
from hard_checkpoints import COUNT, FAMILIES, Change, assert_finite, known, numbers
from hypothesis import given, settings
from hypothesis import strategies as st

from mipmap_plugin.effects import Effects
from mipmap_plugin.errors import MipmapPluginError
from mipmap_plugin.models import load_model

PREFIXES = ["x", "z", "scale", "scale_0", "rot", "rot_0", "opacity", "f_dc", "f_rest", "filter_3D", "f_offset", "f_anchor_feat", "level", "extra"]

# The part of the renderers' catalog that a file can hold.
ROWS = {
    "scale 0": [("scale", 3, -np.inf)],
    "scale 1e-9": [("scale", 3, float(np.log(1e-9)))],
    "scale 1e4": [("scale", 3, float(np.log(1e4)))],
    "needle": [("scale", 3, float(np.log(1e-3))), ("scale_0", 3, float(np.log(1e3)))],
    "log scale 88": [("scale", 3, 88.0)],
    "quaternion 0": [("rot", 3, 0.0)],
    "quaternion of norm 1e-30": [("rot", 3, 1e-30)],
    "quaternion of norm 1e30": [("rot", 3, 1e30)],
    "logit 80": [("opacity", 3, 80.0)],
    "logit -80": [("opacity", 3, -80.0)],
    "logit infinite": [("opacity", 3, np.inf)],
    "far away": [("z", 3, 1e6), ("x", 3, 1e6)],
    "bright": [("f_dc", 3, 1e3), ("f_rest", 3, 1e3)],
    "dark": [("f_dc", 3, -1e3), ("f_rest", 3, -1e3)],
    "large features": [("f_anchor_feat", 3, 1e6), ("f_offset", 3, 1e6)],
    "filter 0": [("filter_3D", 3, 0.0)],
    "filter 1e6": [("filter_3D", 3, 1e6)],
    **{f"NaN in {prefix}": [(prefix, 3, np.nan)] for prefix in PREFIXES},
    **{f"infinity in {prefix}": [(prefix, 3, np.inf)] for prefix in ("x", "scale", "rot", "f_rest")},
    "every row the same": [(prefix, row, 0.1) for prefix in PREFIXES if prefix != "level" for row in range(COUNT)],
}


VIEW = tiny.cameras(1, width=8, height=6)[0]


def check(folder: Path, make: Callable[[Path, list[Change]], Path], changes: list[Change], cameras=(VIEW,)) -> str:
    """Whether the model was "drawn" or "refused"."""
    folder.mkdir(exist_ok=True)
    try:
        model = load_model(make(folder / "m", changes))
    except MipmapPluginError as error:
        assert "\n" not in str(error)
        return "refused"
    effects = Effects(1, model.trained.screen_filter, model.trained.eps2d, near_plane=0.01)
    for camera in cameras:
        assert_finite(model, "reference", replace(camera, time=0.3), effects)
    return "drawn"


@pytest.mark.parametrize("family", FAMILIES)
def test_one_extreme_row_neither_changes_the_other_rows_nor_refuses_the_file(tmp_path, family):
    outcomes = {name: check(tmp_path / "work", FAMILIES[family], changes) for name, changes in ROWS.items()}
    refused = {name for name, outcome in outcomes.items() if outcome == "refused"}
    assert refused <= ({"every row the same"} if family == "octree" else set())


changes = st.lists(st.tuples(st.sampled_from(PREFIXES), st.integers(0, COUNT - 1), numbers | st.sampled_from([np.nan, np.inf])), max_size=5)


@pytest.mark.parametrize("family", FAMILIES)
@settings(known, max_examples=12)
@given(changes=changes)
def test_any_numbers_in_a_familys_file(tmp_path_factory, family, changes):
    check(tmp_path_factory.getbasetemp() / family, FAMILIES[family], changes)


@pytest.mark.slow
@pytest.mark.parametrize("family", FAMILIES)
@settings(known, max_examples=1000)
@given(changes=changes)
def test_any_numbers_in_a_familys_file_at_length(tmp_path_factory, family, changes):
    check(tmp_path_factory.getbasetemp() / family, FAMILIES[family], changes, (VIEW, VIEW.zoomed(1 / 64), VIEW.zoomed(16)))
