"""SwinIR (Liang et al. 2021), the network that Mipmap-GS zooms in with, in its published configurations and with seeded weights."""

import sys
import warnings

import pytest
import tiny
import torch

from mipmap_plugin import cli
from mipmap_plugin.adaptation.target import super_resolution
from mipmap_plugin.adaptation.target.super_resolution import Network
from mipmap_plugin.process.torchvision_absent import torchvision_optional
from mipmap_plugin.wrap import wrap_model

# main_test_swinir.py, define_model: classical (001), lightweight (002) and real-world (003) super-resolution.
CLASSICAL = dict(depths=[6] * 6, embed_dim=180, num_heads=[6] * 6, upsampler="pixelshuffle", resi_connection="1conv")
LIGHT = dict(depths=[6] * 4, embed_dim=60, num_heads=[6] * 4, upsampler="pixelshuffledirect", resi_connection="1conv")
REAL = dict(CLASSICAL, upsampler="nearest+conv")
PUBLISHED = {
    "classical x2": (2, CLASSICAL), "classical x4": (4, CLASSICAL), "lightweight x2": (2, LIGHT), "lightweight x4": (4, LIGHT), "real x4": (4, REAL),
}  # fmt: skip


@pytest.fixture(autouse=True)
def own_cache(monkeypatch, tmp_path):
    monkeypatch.setenv("MIPMAP_PLUGIN_CACHE", str(tmp_path / "cache"))


@pytest.fixture(scope="module")
def swinir():
    with torchvision_optional(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        pytest.importorskip("spandrel", reason="spandrel is in the extra sr")
        from spandrel.architectures.SwinIR.__arch.SwinIR import SwinIR

    def build(scale, kind):
        torch.manual_seed(scale)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return SwinIR(upscale=scale, in_chans=3, img_size=64, window_size=8, img_range=1.0, mlp_ratio=2, **kind).eval()

    return build


def saved(path, network):
    """As the authors publish weights: under `params`."""
    torch.save({"params": network.state_dict()}, path)
    return path


def picture(height, width):
    return torch.rand(height, width, 3, generator=torch.Generator().manual_seed(0))


def own_image(network, image):
    with torch.no_grad():
        return network(image.movedim(-1, 0)[None])[0].movedim(0, -1).clamp(0, 1)


@pytest.mark.parametrize("name", PUBLISHED)
def test_each_published_configuration_gives_its_own_image(swinir, tmp_path, name):
    """Told from the weights alone, and for a size that is no multiple of its windows."""
    scale, kind = PUBLISHED[name]
    network, image = swinir(scale, kind), picture(11, 20)
    enlarged = Network(saved(tmp_path / "net.pth", network))(image, (11 * scale, 20 * scale))
    torch.testing.assert_close(enlarged, own_image(network, image), atol=5e-4, rtol=0)  # kept in half precision
    assert enlarged.std() > 0.01


def test_an_image_larger_than_a_tile_has_no_seam(swinir, tmp_path, monkeypatch):
    """Its authors' library advises against tiles: it sees all of the image."""
    network, image = swinir(2, LIGHT), picture(40, 24)
    monkeypatch.setattr(super_resolution, "TILE", 16)
    enlarged = Network(saved(tmp_path / "net.pth", network))(image, (80, 48))
    torch.testing.assert_close(enlarged, own_image(network, image), atol=5e-4, rtol=0)


def test_it_is_fused_with_the_base_at_zoom_in(swinir, tmp_path):
    path = saved(tmp_path / "net.pth", swinir(2, LIGHT))
    views = tiny.cameras(2)
    run = lambda **settings: wrap_model(tiny.model(), cameras=views).adapt(2.0, steps=2, views="given", returns="last", **settings)  # noqa: E731
    fused = run(upsampler=str(path))
    assert "net.pth fused with it" in fused.report.filters and "upsampling" in fused.report.seconds
    assert not torch.equal(fused.model.parameters()["sh0"], run().model.parameters()["sh0"])


@pytest.fixture
def torch_warns_each_time():
    """Otherwise torch warns of a thing once in a process."""
    torch.set_warn_always(True)
    yield
    torch.set_warn_always(False)


def test_nothing_that_its_code_warns_of_reaches_the_caller(swinir, tmp_path, recwarn, capfd, torch_warns_each_time):
    """It calls torch.meshgrid without an index order, of which torch warns."""
    path = saved(tmp_path / "net.pth", swinir(2, LIGHT))
    recwarn.clear()
    Network(path)(torch.zeros(8, 8, 3), (16, 16))
    assert recwarn.list == [] and capfd.readouterr() == ("", "")


@pytest.mark.parametrize(("asked", "heard"), [([], {"ours"}), (["default"], {"ours", "theirs"})])
def test_warnings_of_others_do_not_reach_the_terminal_and_ours_do(monkeypatch, capsys, asked, heard):
    """Unless Python itself was asked for them (-W). They come as sentences, without a place in the source."""

    def command(**_):
        warnings.warn_explicit("theirs", UserWarning, "x.py", 1, module="torch.functional")
        warnings.warn_explicit("ours", UserWarning, "y.py", 1, module="mipmap_plugin.adaptation.optimization.resume")

    monkeypatch.setattr(sys, "warnoptions", asked)
    monkeypatch.setattr(cli.app, "cli", command)
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        assert cli.main([]) == 0
    assert set(capsys.readouterr().err.splitlines()) == {f"mipmap-plugin: {each}" for each in heard}
