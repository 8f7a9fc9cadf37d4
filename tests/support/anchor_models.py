"""Models of anchors, and how they are compared."""

import anchor_checkpoints as checkpoints
import anchor_oracle as oracle
import numpy as np
import pytest
import tiny
import torch
from anchor_checkpoints import Layout

from mipmap_plugin.adaptation.target.base_images import BaseImages
from mipmap_plugin.adaptation.target.pseudo_truth import PseudoTruth
from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.errors import CheckpointError
from mipmap_plugin.evaluation.metrics import psnr
from mipmap_plugin.models import load_model
from mipmap_plugin.models.columns import C0
from mipmap_plugin.recipes import recipe
from mipmap_plugin.wrap import wrap_model

LAYOUTS = {
    "plain": Layout(),
    "united": Layout(united=True),
    "distance everywhere": Layout(distance=("opacity_mlp", "cov_mlp", "color_mlp")),
    "distance of colors, appearance": Layout(distance=("color_mlp",), appearance=(5, 4)),
    "feature bank": Layout(bank=True, distance=("opacity_mlp",), appearance=(3, 2), united=True),
}

VIEWS = tiny.cameras(6, width=48, height=36)


def load(tmp_path, layout=Layout(), **options):  # noqa: B008
    checkpoints.write(tmp_path / "model", layout, **options)
    return load_model(tmp_path / "model")


def agrees(gaussians, rows) -> None:
    """The splats are those of the oracle, in its order, to 1e-5."""
    assert len(gaussians) == len(rows) > 5
    shown = [gaussians.means, gaussians.scales, gaussians.quats, gaussians.opacities, gaussians.sh[:, 0] * C0 + 0.5]
    for part, values in enumerate(shown, start=1):
        np.testing.assert_allclose(values.detach().numpy(), np.array([row[part] for row in rows]), rtol=0, atol=1e-5)


def assert_decoded(tmp_path, layout, zoom, count=40) -> None:
    """As by the formulas, in float64."""
    view, states = VIEWS[1].zoomed(zoom), checkpoints.weights(layout)
    appearance = states["appearance"]["embedding.weight"].astype(np.float64).mean(0) if layout.appearance else None
    rows = oracle.decode(checkpoints.columns(layout, count=count), states, layout, view, appearance)
    agrees(load(tmp_path, layout, count=count).gaussians(view), rows)


def assert_saved(tmp_path, layout) -> None:
    """Byte for byte, but for the header of the PLY."""
    model = load(tmp_path, layout)
    saved = model.copy().save(tmp_path / "saved", provenance={"scale": 0.25})
    first, second = (place / "point_cloud" / "iteration_30000" for place in (tmp_path / "model", tmp_path / "saved"))
    assert saved == second / "point_cloud.ply"
    assert sorted(p.name for p in first.iterdir()) == sorted(p.name for p in second.iterdir())
    for file in first.iterdir():
        assert (second / file.name).read_bytes().split(b"end_header")[-1] == file.read_bytes().split(b"end_header")[-1]
    assert (tmp_path / "saved/cfg_args").read_bytes() == (tmp_path / "model/cfg_args").read_bytes()
    assert is_same(state_of(model), state_of(load_model(tmp_path / "saved")))


def assert_adapts(model, scale, least, steps) -> None:
    """It gains at least so many dB, moves what may move, and leaves the base as it is."""
    before = state_of(model)
    gained, adapted = gain(model, scale, steps=steps)
    after = state_of(adapted)
    assert gained > least
    assert is_same(before, state_of(model))
    moved = {"features", "scales", *model.shared_parameters(), *(["offsets"] if scale < 1 else [])}
    assert {name for name in before if not torch.equal(before[name], after[name])} == moved


def state_of(model):
    return {name: held.detach().clone() for name, held in {**model.parameters(), **model.shared_parameters()}.items()}


def is_same(one, other) -> bool:
    return one.keys() == other.keys() and all(torch.equal(one[name], other[name]) for name in one)


def gain(model, scale, **settings):
    """dB against the pseudo truth over the base's own render at the new scale, on the views adapted to; and the adapted model."""
    wrapped = wrap_model(model, cameras=VIEWS)
    adapted = wrapped.adapt(scale, views="given", check_every=10, **{"steps": 30, **settings})
    config = recipe("default", scale, resize="pil-bicubic")
    truth = PseudoTruth(BaseImages(model, adapted.backend, wrapped.effects()), scale, config)

    def decibel(image, view):
        return psnr(resize(image, truth(view).shape[:2], config.resize), truth(view))

    views = VIEWS[:2]
    gained = [decibel(adapted.render(v.zoomed(scale)).image, v) - decibel(wrapped.render(v.zoomed(scale)).image, v) for v in views]
    return sum(gained) / len(views), adapted.model


def refused(path, sentence) -> None:
    with pytest.raises(CheckpointError, match=sentence) as caught:
        load_model(path)
    assert "\n" not in str(caught.value)
