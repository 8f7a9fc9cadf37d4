"""Reference values evaluated by hand in float64, for which the modules' own tests have no place."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from exchange_files import RECORD
from samples import t2_camera, t3_gaussian

from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.effects import Effects
from mipmap_plugin.formats.magic import SPLAT_RECORD, kind_of
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.splatting.filters import footprint
from mipmap_plugin.splatting.harmonics import colors
from mipmap_plugin.splatting.projection import project

MIN_LOGIT = -5.537334267  # logit(1/255): the opacity of the faintest splat that is drawn


def test_t3_view_conic_and_alpha():
    splat, view = t3_gaussian(), t2_camera()
    camera_point = splat.means[0] @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]
    assert camera_point.tolist() == pytest.approx([0.355789474, -0.134210526, 4.325263158], abs=1e-8)
    ellipse = footprint(project(splat, view, 0.2), splat.opacities, "classic", 0.3)
    conic = 1 / ellipse.across, -ellipse.shear / ellipse.across, 1 / ellipse.yy + ellipse.shear**2 / ellipse.across
    assert [float(entry) for entry in conic] == pytest.approx([0.332591097, -0.034755101, 0.925606762], abs=1e-8)
    dx, dy = (torch.tensor([pixel + 0.5], dtype=torch.float64) - at for pixel, at in ((37, 37.758091993), (21, 21.765879776)))
    alpha = float(ellipse.alpha(ellipse.packed(), dx, dy))
    assert float(splat.opacities) == pytest.approx(0.731058579, abs=1e-9)
    assert alpha == pytest.approx(0.701404548, abs=1e-8) and math.log(alpha / float(splat.opacities)) == pytest.approx(-0.041408769, abs=1e-8)


def test_t3_color():
    splat, view = t3_gaussian(), t2_camera()
    assert colors(splat.sh, splat.means, view.center, 0)[0].tolist() == pytest.approx([0.641047396, 0.415371562, 0.528209479], abs=1e-9)
    for degree in (0, 1):
        dark = torch.cat([splat.sh - 2, splat.sh.new_zeros(1, (degree + 1) ** 2 - 1, 3)], dim=1)
        assert colors(dark, splat.means, view.center, degree)[0, 1:].tolist() == [0.0, 0.0]


def test_t5_record_of_a_splat_file(tmp_path):
    [record] = np.frombuffer(RECORD, SPLAT_RECORD)
    assert record["position"].tolist() == pytest.approx([-21.4308968, -18.3631401, -22.6337585], abs=1e-6)
    assert record["scale"].tolist() == pytest.approx([1.77184176, 0.90761751, 4.88086510], abs=1e-7)
    assert record["color"].tolist() == [117, 201, 255, 255]
    assert ((record["quat"] - 128.0) / 128).tolist() == [0.9296875, -0.0546875, -0.3046875, 0.203125]
    (tmp_path / "one").write_bytes(RECORD)
    assert kind_of(tmp_path / "one") == "splat"


def test_t6_logit_of_the_faintest_splat():
    faintest = VanillaModel.from_gaussians(_with_opacity(1 / 255))
    assert float(faintest.parameters()["opacities"]) == pytest.approx(MIN_LOGIT, abs=1e-6)


@pytest.mark.parametrize(("difference", "drawn"), [(1e-6, True), (-1e-6, False)])
def test_t6_fainter_splats_are_not_drawn(difference, drawn):
    splat, view = _with_opacity(torch.sigmoid(torch.tensor(MIN_LOGIT + difference, dtype=torch.float64))), t2_camera()
    x, y = project(splat, view, 0.2).means2d[0].tolist()
    on_a_pixel = replace(view, cx=view.cx + 37.5 - x, cy=view.cy + 21.5 - y)
    assert bool(ReferenceBackend().render(splat, on_a_pixel, Effects(0)).alpha.any()) == drawn


def _with_opacity(opacity) -> Gaussians:
    return replace(t3_gaussian(), opacities=torch.tensor([float(opacity)], dtype=torch.float64))
