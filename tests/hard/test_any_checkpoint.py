"""Whatever numbers a checkpoint holds: a finite image with finite gradients, or one sentence. hypothesis looks for the numbers."""

import importlib.util
from dataclasses import replace

import numpy as np
import ply_files
import pytest
from hard_checkpoints import assert_finite, known, numbers
from hypothesis import given, settings
from hypothesis import strategies as st

from mipmap_plugin.backends.conformance.cases import view
from mipmap_plugin.effects import Effects
from mipmap_plugin.errors import MipmapPluginError
from mipmap_plugin.models import load_model

BACKENDS = ["reference", "cpu"] if importlib.util.find_spec("numba") else ["reference"]
FILTERS = ["classic", "antialiased", "mip", "analytic"]
NAMES = ply_files.splat_names(3)

# Ordinary numbers, by column: a splat in the middle of the view.
USUAL = {"z": 3.0, "scale_0": -1.0, "scale_1": -1.5, "scale_2": -2.0, "rot_0": 1.0, "rot_1": 0.3, "opacity": 1.0}

VIEWS = [view(9, 7, turned=True), view(9, 7).zoomed(16), view(18, 14).zoomed(1 / 64), replace(view(5, 4), fx=1e5, fy=1e-3)]


@st.composite
def rows(draw):
    """One splat in the view, some of whose numbers are anything."""
    changed = draw(st.dictionaries(st.sampled_from(NAMES), numbers, max_size=6))
    if draw(st.booleans()):  # a place that can be seen, however far away
        changed["z"] = abs(changed.get("z", 3.0))
        changed |= {axis: changed["z"] * draw(st.floats(-0.4, 0.4)) for axis in "xy"}
    return {name: float(np.clip(changed.get(name, USUAL.get(name, 0.1)), -3.4e38, 3.4e38)) for name in NAMES}


def check(folder, splats, screen_filter, camera):
    path = ply_files.write(folder / "a.ply", {name: np.array([row[name] for row in splats], np.float32) for name in NAMES})
    try:
        model = load_model(path)
    except MipmapPluginError as error:
        assert "\n" not in str(error)
        return
    for name in BACKENDS:
        assert_finite(model, name, camera, Effects(1, screen_filter, near_plane=0.01))


cases = given(splats=st.lists(rows(), min_size=1, max_size=3), screen_filter=st.sampled_from(FILTERS), camera=st.sampled_from(VIEWS))


@settings(known, max_examples=100)
@cases
def test_any_finite_checkpoint_gives_a_finite_image_and_gradients_or_a_sentence(tmp_path_factory, splats, screen_filter, camera):
    check(tmp_path_factory.getbasetemp(), splats, screen_filter, camera)


@pytest.mark.slow
@settings(known, max_examples=20_000)
@cases
def test_any_finite_checkpoint_at_length(tmp_path_factory, splats, screen_filter, camera):
    check(tmp_path_factory.getbasetemp(), splats, screen_filter, camera)
