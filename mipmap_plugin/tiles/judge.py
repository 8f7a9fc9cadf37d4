"""The whole scene, judged on views that nothing was adapted to: the base as it is, the start, and the joined tiles."""

from __future__ import annotations

from mipmap_plugin.adaptation.report import AS_IT_IS
from mipmap_plugin.formats.torch_file import load_torch
from mipmap_plugin.tiles.folder import START
from mipmap_plugin.tiles.scene import TiledScene
from mipmap_plugin.tiles.start import psnr
from mipmap_plugin.tiles.steering import Steered, open_state, result
from mipmap_plugin.tiles.truth import Truths

JOINED = "the joined tiles"


def judged(scene: TiledScene) -> tuple[dict[str, float], str]:
    """The PSNR (dB) of each on whole views, and the name of what is returned: the best, or the last where the settings say so."""
    if not scene.views.choosing:
        return {}, JOINED
    truths, start = Truths(scene), f"the start, {load_torch(scene.folder / START)['name']}"
    first, last = (open_state(scene, state) for state in (Steered.before(scene.folder, 0), result(scene.folder)))
    states = {AS_IT_IS: scene.base, start: first, JOINED: last}
    psnrs = {name: psnr(scene, splats, truths, scene.views.choosing) for name, splats in states.items()}
    best = max(reversed(psnrs), key=psnrs.__getitem__)
    return psnrs, JOINED if scene.config.returns == "last" else best
