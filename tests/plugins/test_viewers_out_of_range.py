"""Viewers of a stranger, and the settings by which they draw: what is out of range is named."""

import numpy as np
import pytest

from mipmap_plugin import register_viewer
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.render_settings import EvenBuckets, Packing, RenderSettings
from mipmap_plugin.splatting.viewers import Viewer, single_viewers

NAN = float("nan")


def kiosk(eps2d=0.3, **changes):
    return Viewer("kiosk", "Kiosk", "ours", "classic", eps2d, **changes)


@pytest.mark.parametrize("name", ["", " ", "../kiosk", "our/kiosk", "x\ny", "-v", ".hidden"])
def test_names_are_parts_of_file_names(name):
    with pytest.raises(SettingsError, match=r"a name is a text of a line|a name begins with a letter"):
        register_viewer(name, kiosk())


OUT_OF_RANGE = {
    ("render settings", RenderSettings): [
        {"min_alpha": 0.0}, {"min_alpha": 2.0}, {"min_alpha": "x"}, {"min_alpha": NAN}, {"min_transmittance": 2.0}, {"radius": 0},
        {"radius": -3.0}, {"tile": 0}, {"tile": 3.5}, {"tile": 100_000}, {"max_alpha": 0.0}, {"max_color": -1.0}, {"color_steps": (0.1, 0.1)},
        {"color_steps": [0.1, 0.1, 0.1]}, {"min_variance": -1.0}, {"max_half_axis": 0.0, "radius": 3.0}, {"frame": -1.0}, {"picture_step": -1.0},
        {"linear_light": 0.0}, {"packing": "yes"}, {"even_buckets": True}, {"radial": "yes"}, {"bucketed": "yes"},
        {"fades": "yes"}, {"fits_picture": "yes"},
    ],
    ("packing", Packing): [
        {"opacity": (0.0,)}, {"color": 0.0}, {"bands": (0.0,)}, {"log_scales": (9.0, -12.0, 0.1)}, {"quats": "smallest"}, {"bands": [0.1]},
    ],
    ("even buckets", EvenBuckets): [{"steps": 0}, {"steps": 2.5}, {"steps": 1 << 40}, {"sphere_from": NAN}],
    ("viewer 'kiosk'", kiosk): [
        {"near_plane": NAN}, {"near_plane": "0.2"}, {"near_plane": -5}, {"sh_degree": -1}, {"eps2d": True}, {"eps2d": 1e300},
        {"read_degrees": ()}, {"read_degrees": 3}, {"read_degrees": (0, [1])}, {"read_degrees": (5,)},
    ],
}  # fmt: skip


@pytest.mark.parametrize(("of", "wrong"), [(of, wrong) for of, each in OUT_OF_RANGE.items() for wrong in each])
def test_what_is_out_of_range_is_refused(of, wrong):
    what, make = of
    with pytest.raises(SettingsError, match=f"{what}: {next(iter(wrong))} must be"):
        make(**wrong)


@pytest.mark.parametrize(("largest", "step"), [(1.0, 0.3), (4.0, 0.35), (0.5, 1.0)])
def test_steps_of_colors_that_pass_their_limit_are_refused(largest, step):
    with pytest.raises(SettingsError, match=f"max_color must be a multiple of each of color_steps, .* got {largest} and {step}"):
        RenderSettings(max_color=largest, color_steps=(largest / 4, step, step))


def test_numbers_of_numpy_are_numbers():
    assert RenderSettings(min_alpha=np.float64(0.01)).min_alpha == 0.01


def test_a_viewer_that_cannot_be_loaded_hides_no_other():
    register_viewer("missing", "nosuch:VIEWER")
    register_viewer("none", ())
    assert {"spark", "classic"} <= set(single_viewers()) and not {"missing", "none", "portable"} & set(single_viewers())
