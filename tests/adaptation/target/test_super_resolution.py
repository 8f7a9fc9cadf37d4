"""Networks as upsamplers: read without executing, cascaded to any size, in tiles where they are large, kept on disk."""

import sys
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace
from unittest.mock import Mock

import pytest
import torch
from torch import nn
from torch_checkpoints import Hostile

from mipmap_plugin.adaptation.target import super_resolution
from mipmap_plugin.adaptation.target.disk_cache import cache_folder, cached, fingerprint
from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.adaptation.target.super_resolution import Network
from mipmap_plugin.adaptation.target.upsamplers import find_upsampler, network_input, placed
from mipmap_plugin.errors import CheckpointError, PluginError, SettingsError
from mipmap_plugin.evaluation.metrics import psnr
from mipmap_plugin.formats.atomic import sha256
from mipmap_plugin.process.torchvision_absent import torchvision_optional


@pytest.fixture(autouse=True)
def own_cache(monkeypatch, tmp_path):
    monkeypatch.setenv("MIPMAP_PLUGIN_CACHE", str(tmp_path / "cache"))


@pytest.fixture
def spandrel():
    with torchvision_optional():
        return pytest.importorskip("spandrel", reason="spandrel is in the extra sr")


def picture(height=20, width=24, seed=0):
    coarse = torch.rand(5, 6, 3, generator=torch.Generator().manual_seed(seed))
    return resize(coarse, (height, width), "pil-bicubic").clamp(0, 1)


def compact(spandrel, scale=2):
    """A small network of random weights, of an architecture that spandrel knows (RealESRGAN Compact)."""
    torch.manual_seed(scale)
    with torchvision_optional():
        from spandrel.architectures.Compact.__arch.SRVGG import SRVGGNetCompact
    return SRVGGNetCompact(num_feat=8, num_conv=2, upscale=scale).eval()


@pytest.fixture
def network_file(spandrel, tmp_path):
    def write(name="net.pth", scale=2):
        weights = compact(spandrel, scale).state_dict()
        if name.endswith(".safetensors"):
            pytest.importorskip("safetensors.torch").save_file(weights, tmp_path / name)
        else:
            torch.save({"params_ema": weights} if name.endswith(".pth") else weights, tmp_path / name)
        return tmp_path / name

    return write


# Files


@pytest.mark.parametrize("name", ["net.pth", "net.pt", "net.safetensors"])
def test_every_kind_of_file_gives_the_networks_own_image(spandrel, network_file, name):
    image = picture()
    with torch.no_grad():
        expected = compact(spandrel)(image.movedim(-1, 0)[None])[0].movedim(0, -1).clamp(0, 1)
    enlarged = find_upsampler(str(network_file(name)))(image, (40, 48))
    torch.testing.assert_close(enlarged, expected, atol=5e-4, rtol=0)  # kept in half precision
    assert not enlarged.is_inference()


def test_a_torchscript_file_is_read_without_being_executed(spandrel, tmp_path, monkeypatch):
    network = compact(spandrel)
    torch.jit.trace(network, torch.rand(1, 3, 16, 16)).save(str(tmp_path / "net.pt"))
    monkeypatch.setattr(torch.jit, "load", None)
    with torch.no_grad():
        expected = network(picture().movedim(-1, 0)[None])[0].movedim(0, -1).clamp(0, 1)
    torch.testing.assert_close(Network(tmp_path / "net.pt")(picture(), (40, 48)), expected, atol=5e-4, rtol=0)


def test_what_is_no_enlarging_network_is_refused_in_a_sentence(spandrel, network_file, tmp_path):
    torch.save({"weights": Hostile()}, tmp_path / "hostile.pth")
    torch.save({"weights": torch.zeros(3)}, tmp_path / "other.pth")
    torch.save(compact(spandrel).state_dict() | {"body.0.weight": torch.ones(())}, tmp_path / "odd.pth")
    (tmp_path / "text.safetensors").write_text("no tensors")
    (tmp_path / "spoiled.pth").write_bytes((tmp_path / "other.pth").read_bytes().replace(b"PK\x01\x02", b"PK\x01\x03"))  # its list of contents
    for name, sentence in {
        "hostile.pth": "is not executed",
        "other.pth": "not a network that spandrel supports",
        "odd.pth": "not a network that spandrel supports .tuple index out of range",
        "text.safetensors": "is damaged; download it again",
        "spoiled.pth": "is a damaged zip archive",
    }.items():
        with pytest.raises(CheckpointError, match=sentence):
            Network(tmp_path / name)
    with pytest.raises(SettingsError, match="does not enlarge images; give one that does"):
        Network(network_file(scale=1))


def test_memory_that_runs_out_is_not_told_as_a_file_of_something_else(spandrel, network_file, monkeypatch):
    monkeypatch.setattr(spandrel.ModelLoader, "load_from_state_dict", Mock(side_effect=MemoryError))
    with pytest.raises(MemoryError):
        Network(network_file())


def test_a_file_that_is_not_there_and_a_name_that_nobody_registered():
    with pytest.raises(SettingsError, match=r"there is no upsampler file nowhere\.pth; check the path"):
        find_upsampler("nowhere.pth")
    with pytest.raises(SettingsError, match="there is no upsampler 'swin'; choose from bicubic, lanczos, or give the file of a network"):
        find_upsampler("swin")


def test_without_spandrel_the_remedy_is_named(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "spandrel", None)
    torch.save({}, tmp_path / "net.pth")
    with pytest.raises(PluginError, match=r'pip install "mipmap-plugin\[sr\]"'):
        Network(tmp_path / "net.pth")


@pytest.mark.parametrize(("name", "least_gain"), [("X2.pt", 0.5), ("X4.pt", 0.5), ("realesr-animevideov3.pth", -9)])
def test_real_weights_restore_detail(spandrel, shared_data, name, least_gain):
    """Above bicubic in dB; the last is trained to look sharp, which costs dB."""
    from mipmap_plugin.formats.images import read_image

    truth = read_image(shared_data / "images" / "lego" / "test" / "r_0.png", (1.0, 1.0, 1.0))[300:492, 300:492]
    network = Network(shared_data / "upsamplers" / name)
    scale = 2 if name == "X2.pt" else 4
    small = resize(truth, (192 // scale, 192 // scale), "pil-bicubic").clamp(0, 1)
    gain = psnr(network(small, (192, 192)), truth) - psnr(resize(small, (192, 192), "pil-bicubic"), truth)
    assert gain > least_gain


# Any size


class Doubling:
    """A descriptor as spandrel's, of a network that repeats pixels, and notes what it was given."""

    scale, input_channels, output_channels = 2, 3, 3

    def __init__(self, tiling="SUPPORTED"):
        self.tiling, self.given = SimpleNamespace(name=tiling), []

    def to(self, device):
        return self

    @torch.inference_mode()
    def __call__(self, planes):
        self.given.append(tuple(planes.shape[2:]))
        return nn.functional.interpolate(planes, scale_factor=self.scale, mode="nearest")


@pytest.fixture
def doubling(monkeypatch, tmp_path):
    descriptor = Doubling()
    monkeypatch.setattr(super_resolution, "_load", lambda path: descriptor)
    (tmp_path / "net.pth").write_bytes(b"weights")
    return Network(tmp_path / "net.pth"), descriptor


def test_a_network_is_applied_until_its_image_is_large_enough_and_resized_to_the_exact_size(doubling):
    network, descriptor = doubling
    image = picture()
    enlarged = network(image, (150, 180))
    assert descriptor.given == [(20, 24), (40, 48), (80, 96)]
    eightfold = image.repeat_interleave(8, 0).repeat_interleave(8, 1)
    torch.testing.assert_close(enlarged, resize(eightfold, (150, 180), "pil-bicubic").clamp(0, 1), atol=5e-4, rtol=0)


def test_a_large_image_goes_through_in_overlapping_tiles(doubling, monkeypatch):
    network, descriptor = doubling
    monkeypatch.setattr(super_resolution, "TILE", 16)
    monkeypatch.setattr(super_resolution, "MARGIN", 4)
    image = picture(20, 40)
    torch.testing.assert_close(network(image, (40, 80)), image.repeat_interleave(2, 0).repeat_interleave(2, 1), atol=5e-4, rtol=0)
    assert descriptor.given == [(20, 20), (20, 24), (20, 12), (8, 20), (8, 24), (8, 12)]


@pytest.mark.parametrize("tiling", ["DISCOURAGED", "INTERNAL"])
def test_an_architecture_that_looks_at_all_of_an_image_gets_all_of_it(doubling, monkeypatch, tiling):
    network, descriptor = doubling
    monkeypatch.setattr(super_resolution, "TILE", 16)
    descriptor.tiling.name = tiling
    network(picture(), (40, 48))
    assert descriptor.given == [(20, 24)]


def test_tiles_of_a_real_architecture_meet_without_a_seam(spandrel, network_file, monkeypatch):
    whole = Network(network_file())(picture(40, 40), (80, 80))
    monkeypatch.setattr(super_resolution, "TILE", 16)
    monkeypatch.setattr(super_resolution, "MARGIN", 8)
    torch.testing.assert_close(Network(network_file())(picture(40, 40), (80, 80)), whole, atol=1e-3, rtol=0)


# The cache


def test_an_image_is_enlarged_once_and_found_again_by_another_run(doubling, tmp_path):
    network, descriptor = doubling
    first = network(picture(), (40, 48))
    again = Network(tmp_path / "net.pth")(picture(), (40, 48))
    assert torch.equal(first, again) and len(descriptor.given) == 1
    network(picture(), (39, 48))
    network(picture(seed=1), (40, 48))
    (tmp_path / "net.pth").write_bytes(b"other weights")
    Network(tmp_path / "net.pth")(picture(), (40, 48))
    assert len(descriptor.given) == 4


def test_a_damaged_file_of_the_cache_is_made_anew():
    image, name = picture(), fingerprint(picture(), "facts")
    cached(name, lambda: image)
    [file] = cache_folder().rglob("*.pt")
    file.write_bytes(b"half")
    torch.testing.assert_close(cached(name, lambda: image), image, atol=5e-4, rtol=0)
    torch.testing.assert_close(cached(name, lambda: pytest.fail("it is there")), image, atol=5e-4, rtol=0)


def test_the_cache_lies_in_the_users_cache_folder_unless_told_otherwise(monkeypatch, tmp_path):
    assert cache_folder() == tmp_path / "cache"
    monkeypatch.delenv("MIPMAP_PLUGIN_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder() == tmp_path / "mipmap_plugin"


# torchvision


@pytest.fixture
def broken_torchvision(monkeypatch, tmp_path):
    """A torchvision that fails at import as one of another build does."""
    for name in [name for name in sys.modules if name.split(".")[0] == "torchvision"]:
        monkeypatch.delitem(sys.modules, name)
    (tmp_path / "torchvision").mkdir()
    (tmp_path / "torchvision" / "__init__.py").write_text("import torchvision.parts\n")
    (tmp_path / "torchvision" / "parts.py").write_text("raise RuntimeError('operator torchvision::nms does not exist')\n")
    monkeypatch.syspath_prepend(str(tmp_path))


def test_a_broken_torchvision_is_stood_in_for_and_leaves_nothing_behind(broken_torchvision):
    with torchvision_optional(models={"alexnet": lambda: "ours"}):
        from torchvision import models
        from torchvision.transforms.functional import rotate
    assert models.alexnet() == "ours"
    with pytest.raises(ImportError, match=r"torchvision\.transforms\.functional\.rotate needs a torchvision that works"):
        rotate()
    assert not any(name.split(".")[0] == "torchvision" for name in sys.modules)


def test_a_torchvision_that_works_is_used(monkeypatch):
    works = SimpleNamespace(models="its own")
    monkeypatch.setitem(sys.modules, "torchvision", works)
    with torchvision_optional(models={"alexnet": None}):
        import torchvision
    assert torchvision is works and sys.modules["torchvision"] is works


def test_a_job_reads_the_network_that_came_with_it(tmp_path):
    """Another job of the same worker may name its own alike, and end first."""
    for content in ("mine", "other"):
        (tmp_path / content).write_text(content)

    def another_job():
        with placed("net.pth", tmp_path / "other"):
            return network_input("net.pth")

    with placed("net.pth", tmp_path / "mine"), ThreadPoolExecutor(1) as pool:
        assert pool.submit(another_job).result() == {"network": sha256(tmp_path / "other")}
        assert network_input("net.pth") == {"network": sha256(tmp_path / "mine")}
    assert network_input("net.pth") == {}
