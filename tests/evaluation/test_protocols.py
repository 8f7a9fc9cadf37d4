"""The protocols by which photographs become truths: as published, or refused in a sentence."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tiny
import torch
from PIL import Image

from mipmap_plugin.adaptation.target.photographs import at_density_of
from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.camera import Camera
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.evaluation import protocols
from mipmap_plugin.evaluation.evaluate import Evaluator
from mipmap_plugin.evaluation.judged import JudgedView, judged_views, ready_made
from mipmap_plugin.evaluation.metrics import SAME_DB
from mipmap_plugin.evaluation.protocols import PROTOCOLS
from mipmap_plugin.formats.images import write_image
from mipmap_plugin.scenes import Scene

pytestmark = pytest.mark.usefixtures("few_views")


def noise(*shape, seed=0):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def test_p1_truncates_the_mean_of_blocks():
    photograph = noise(24, 32, 3)
    view = JudgedView(tiny.cameras(1)[0], photograph, Path("photograph.png"))
    means = photograph.view(6, 4, 8, 4, 3).mean(dim=(1, 3)) * 255
    torch.testing.assert_close(view.truth(1 / 4, PROTOCOLS["P1"]) * 255, means.floor(), atol=1e-3, rtol=0)


def test_p1_averages_colors_and_alpha_by_themselves_and_composites_afterwards(tmp_path):
    """A red pixel, a transparent one that is stored blue, and two of half alpha; by hand, with both truncations.

    Means: red 255 / 4 = 63.75 and blue 255 / 4, each 63; alpha (255 + 2 * 128) / 4 = 127.75, so 127, or 0.498. On white
    63 * 0.498 + 255 * 0.502 = 159.37 and 128. Composited first it would be (255 + 255 + 2 * 127) / 4 = 191 and 127.
    """
    block = np.array([[[255, 0, 0, 255], [0, 0, 255, 0]], [[0, 0, 0, 128], [0, 0, 0, 128]]], np.uint8)
    Image.fromarray(np.tile(block, (24, 32, 1))).save(tmp_path / "photograph.png")
    cameras = [replace(camera, split="test") for camera in tiny.cameras(1)]
    [view] = judged_views(Scene(tuple(cameras), {cameras[0]: tmp_path / "photograph.png"}, tmp_path), tiny.cameras(1), (1.0, 1.0, 1.0))
    for scale in (1, 1 / 2, 1 / 4):  # of a photograph of twice the base's size
        truth = (view.truth(scale, PROTOCOLS["P1"]) * 255).round().byte()
        assert truth.shape == (24 * scale, 32 * scale, 3) and truth.unique(dim=0).unique(dim=1).tolist() == [[[159, 128, 159]]]
    opaque = JudgedView(view.camera, view.photograph, view.file, view.background, distorted=True, transparent=True)
    assert torch.equal(opaque.truth(1, PROTOCOLS["P1"]), PROTOCOLS["P1"].shrunk(view.photograph, (24, 32)))
    assert torch.equal(view.truth(1 / 2, PROTOCOLS["P3"]), PROTOCOLS["P3"].shrunk(view.photograph, (12, 16)))


@pytest.mark.parametrize(
    ("protocol", "size", "scale", "told"),
    [
        ("P1", (25, 33), 1 / 4, "P1 takes means of whole blocks .*33 x 25 px is not a whole multiple of 8 x 6 px; evaluate by P3"),
        ("P3", (24, 32), 2, "x2 needs 64 x 48 px, but the photographs have only 32 x 24; evaluate a smaller scale"),
    ],
    ids=["without whole blocks", "too small"],
)
def test_a_photograph_of_which_there_is_no_truth_says_what_to_do(protocol, size, scale, told):
    view = JudgedView(tiny.cameras(1)[0], noise(*size, 3), Path("photograph.png"))
    with pytest.raises(SettingsError, match=told):
        view.truth(scale, PROTOCOLS[protocol])


def test_p3_is_pillows_bicubic_on_bytes_and_not_on_floats():
    stored = (noise(24, 32, 3) > 0.5).byte().mul(255)  # black and white: Pillow clamps between its two passes
    view = JudgedView(tiny.cameras(1)[0], stored / 255, Path("photograph.png"))
    bytes_of_pillow = np.asarray(Image.fromarray(stored.numpy()).resize((8, 6), Image.Resampling.BICUBIC))
    truth = (view.truth(1 / 4, PROTOCOLS["P3"]) * 255).round().byte().numpy()
    on_floats = (resize(stored / 255, (6, 8), "pil-bicubic").clamp(0, 1) * 255).round().byte().numpy()
    assert (truth == bytes_of_pillow).all() and (truth != on_floats).any()


def test_images_are_judged_as_the_8_bit_files_that_they_would_be_saved_as():
    image = torch.tensor([-0.1, 0.49 / 255, 0.51 / 255, 1.2])
    assert all(torch.equal(each.as_saved(image), torch.tensor([0, 0, 1 / 255, 1])) for each in PROTOCOLS.values())
    assert torch.equal(protocols.Protocol("floats", "area", eight_bit=False).as_saved(image), image)
    views = [JudgedView(tiny.cameras(1)[0], torch.full((24, 32, 3), 100 / 255), Path("photograph.png"))]
    row = Evaluator(views, PROTOCOLS["P3"]).row("gray", 1, lambda camera: torch.full((*camera.size, 3), 100.4 / 255), gaussians=0)
    assert row.psnr_db == SAME_DB


@pytest.mark.parametrize(("size", "divisor"), [((3286, 4946), 8), ((3361, 5187), 2), ((2078, 3118), 4), ((5992, 4004), 8)])
def test_a_photograph_is_large_enough_for_a_base_whose_size_was_rounded_up(monkeypatch, size, divisor):
    """Captures of mip-NeRF 360, trained at half, a quarter and an eighth of their size, halves rounded up. None is shrunk here, which takes long."""
    monkeypatch.setattr(protocols.Protocol, "shrunk", lambda self, photograph, size: size)
    height, width = size
    full = Camera(width, height, 4000.0, 4000.0, width / 2, height / 2, torch.eye(4), "view", "test")
    base = full.resized(int(width / divisor + 0.5), int(height / divisor + 0.5))
    [camera] = at_density_of([full], [base])
    view = JudgedView(camera, torch.zeros(1).expand(*size, 3), Path("photograph.png"))
    assert view.truth(divisor, PROTOCOLS["P3"]) == camera.zoomed(divisor).size


@pytest.fixture
def folders(tmp_path):
    """A COLMAP scene's photographs, and its copies at a half and, but for rounding, a quarter."""
    for folder, value, size in (("images", 0.2, (97, 130)), ("images_2", 0.4, (49, 65)), ("images_4", 0.6, (24, 33)), ("masks_4", 0.8, (24, 32))):
        write_image(tmp_path / folder / "left" / "a.png", torch.full((*size, 3), value))
    return tmp_path


@pytest.mark.parametrize(("scale", "value"), [(1, 0.6), (2, 0.4), (4, 0.2)])
def test_p4_reads_the_copy_that_has_the_size(folders, scale, value):
    view = JudgedView(replace(tiny.cameras(1)[0], width=33), noise(97, 130, 3), folders / "images_2" / "left" / "a.png")
    truth = view.truth(scale, PROTOCOLS["P4"])
    assert truth.shape == (24 * scale, 33 * scale, 3)
    torch.testing.assert_close(truth, torch.full_like(truth, value), atol=1e-3, rtol=0)


def test_p4_takes_copies_whose_size_differs_by_rounding_alone(folders):
    photograph = folders / "images" / "left" / "a.png"
    assert ready_made(photograph, (28, 33)) == folders / "images_4" / "left" / "a.png"
    with pytest.raises(SettingsError, match=r"P4 needs a\.png at 33 x 29 px"):
        ready_made(photograph, (29, 33))


def test_p4_refuses_a_size_that_no_folder_has(folders, tmp_path):
    view = JudgedView(tiny.cameras(1)[0], noise(97, 130, 3), folders / "images" / "left" / "a.png")
    with pytest.raises(SettingsError, match=r"P4 needs a\.png at 16 x 12 px .* but there is 130 x 97, 65 x 49, 33 x 24; evaluate a"):
        view.truth(1 / 2, PROTOCOLS["P4"])
    with pytest.raises(SettingsError, match="but there is none"):
        ready_made(tmp_path / "a.png", (12, 16))
