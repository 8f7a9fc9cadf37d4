"""LPIPS: the package's own number with weights from a file, what it is fed with, and a sentence for each thing that lacks."""

import importlib.util
import sys
import urllib.error
from unittest.mock import Mock

import pytest
import torch

from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.errors import CheckpointError, PluginError, SettingsError
from mipmap_plugin.evaluation.perceptual import Perceptual
from mipmap_plugin.formats.images import read_image


@pytest.fixture(autouse=True)
def package():
    if importlib.util.find_spec("lpips") is None:
        pytest.skip("lpips is in the extra metrics")


@pytest.fixture
def random_weights(tmp_path):
    """A file of a backbone of random weights, with the classifier that torchvision's has too."""

    def write(backbone):
        from mipmap_plugin.evaluation import perceptual

        torch.manual_seed(0)
        layers = {"alex": perceptual._alexnet, "vgg": perceptual._vgg16}[backbone](pretrained=False).features
        weights = {f"features.{name}": value for name, value in layers.state_dict().items()}
        torch.save({**weights, "classifier.1.weight": torch.zeros(1)}, tmp_path / f"{backbone}.pth")
        return tmp_path / f"{backbone}.pth"

    return write


def pair(side=64):
    rng = torch.Generator().manual_seed(0)
    truth = torch.rand(side, side, 3, generator=rng)
    return resize(resize(truth, (side // 2, side // 2), "area"), (side, side), "pil-bicubic"), truth


def test_alexnets_number_on_a_real_image(shared_data):
    """The value that the same weights give whose LPIPS of the authors' example images is the published 0.722 and 0.138."""
    truth = resize(read_image(shared_data / "images" / "lego" / "test" / "r_0.png", (1.0, 1.0, 1.0)), (100, 100), "area")
    blurred = resize(resize(truth, (50, 50), "area"), (100, 100), "pil-bicubic")
    perceptual = Perceptual("alex", shared_data / "lpips" / "alexnet_features_fp16.pth")
    assert perceptual.label == "LPIPS (alex, normalized)"
    assert perceptual(blurred, truth) == pytest.approx(0.2029, abs=1e-3)
    assert perceptual(truth, truth) == pytest.approx(0, abs=1e-5)


@pytest.mark.parametrize("backbone", ["alex", "vgg"])
def test_the_weights_are_those_of_the_file(random_weights, backbone):
    """The sum over five layers of the heads' weighted squared differences of unit features, written out."""
    file, (image, truth) = random_weights(backbone), pair()
    perceptual = Perceptual(backbone, file)
    import lpips  # which is loaded now, whatever torchvision there is

    network = lpips.LPIPS(net=backbone, pnet_rand=True, verbose=False)
    weights = torch.load(file, weights_only=True)
    for name, value in network.net.named_parameters():
        value.data.copy_(weights["features." + name.split(".", 1)[1]])
    with torch.no_grad():
        expected = network(image.movedim(-1, 0)[None] * 2 - 1, truth.movedim(-1, 0)[None] * 2 - 1)
    assert perceptual(image, truth) == pytest.approx(float(expected), rel=1e-4)


def test_the_papers_feed_vgg_with_images_in_0_to_1(random_weights):
    file, (image, truth) = random_weights("vgg"), pair()
    defined, papers = Perceptual("vgg", file), Perceptual("vgg-01", file)
    assert (defined.label, papers.label) == ("LPIPS (vgg, normalized)", "LPIPS (vgg, 0..1)")
    assert papers(image, truth) == pytest.approx(defined((image.clamp(0, 1) + 1) / 2, (truth + 1) / 2), rel=1e-4)


@pytest.mark.parametrize(("backbone", "side"), [("alex", 31), ("vgg", 16)])
def test_it_is_not_known_for_an_image_smaller_than_the_backbone_needs(random_weights, backbone, side):
    perceptual = Perceptual(backbone, random_weights(backbone))
    assert perceptual(*pair(side)) is not None
    assert perceptual(*pair(side - 1)) is None


def test_another_file_is_refused(tmp_path, random_weights):
    torch.save({"weights": torch.zeros(3)}, tmp_path / "other.pth")
    torch.save(torch.zeros(3), tmp_path / "tensor.pth")
    for file in (tmp_path / "other.pth", tmp_path / "tensor.pth", random_weights("vgg")):
        with pytest.raises(CheckpointError, match="holds no alex backbone as torchvision saves it"):
            Perceptual("alex", file)


@pytest.mark.parametrize(("kept", "said"), [({"weights": torch.zeros(3)}, "holds no alex backbone as torchvision saves it"), (None, "is damaged")])
def test_an_earlier_download_that_is_of_no_use_is_named(tmp_path, monkeypatch, kept, said):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    file = tmp_path / "hub/checkpoints/alexnet-owt-7be5be79.pth"
    file.parent.mkdir(parents=True)
    torch.save(kept, file) if kept else file.write_text("cut off")
    with pytest.raises(CheckpointError, match=rf"checkpoints/alexnet-owt-7be5be79.pth {said}.*; remove it, so that it is downloaded again"):
        Perceptual("alex")


def test_what_lacks_is_named_with_its_remedy(monkeypatch):
    monkeypatch.setattr(torch.hub, "load_state_dict_from_url", Mock(side_effect=urllib.error.URLError("no route")))
    with pytest.raises(SettingsError, match=r"cannot be downloaded .*no route.*; download https://.*vgg16.* and give the file \(--lpips-weights\)"):
        Perceptual("vgg")
    monkeypatch.setitem(sys.modules, "lpips", None)
    with pytest.raises(PluginError, match=r'pip install "mipmap-plugin\[metrics\]"'):
        Perceptual("alex")
