"""Models of anchors, and how they are compared."""

import anchor_checkpoints as checkpoints
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
