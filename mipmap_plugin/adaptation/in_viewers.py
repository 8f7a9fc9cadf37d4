"""dB in single viewers: each of several, and what draws as the base's training did; and viewers that round positions."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import torch

from mipmap_plugin.adaptation.optimization.validation import HARM_DB, Validation
from mipmap_plugin.adaptation.renderers import Renderer
from mipmap_plugin.backends.base import Backend
from mipmap_plugin.camera import Camera, evenly
from mipmap_plugin.effects import Effects
from mipmap_plugin.models.base import SplatModel
from mipmap_plugin.splatting.packing import in_two_steps, packed

# Views and splats by which it is measured how far a viewer that rounds positions displaces splats, and the fraction of displaced ones worth a word.
LOOKED_AT, SAMPLES, DISPLACED = 4, 1 << 14, 0.5


def psnr_per_viewer(validation: Validation, backend: Backend, targets: Mapping[str, Effects], model: SplatModel) -> dict[str, float]:
    """PSNR (dB) of a model in each viewer on the views that choose among states, where it is made for several; {} for one."""
    if len(targets) == 1:
        return {}
    renders = [Renderer(backend, target) for target in targets.values()]
    psnrs = replace(validation, renders=renders).viewer_psnrs(model, validation.choosing)
    return dict(zip(targets, psnrs, strict=True))


def psnr_as_trained(validation: Validation, backend: Backend, targets: Mapping[str, Effects], base: SplatModel, effects: Effects) -> float | None:
    """PSNR (dB) of the base on the same views as its training draws it (`effects`).

    None at x1, where that is the truth itself, and where the file is drawn so too, so that this is the base as it is.
    """
    if validation.scale == 1 or not validation.choosing or effects in targets.values():
        return None
    return replace(validation, renders=[Renderer(backend, effects)]).viewer_psnrs(base, validation.choosing)[0]


def better_as_trained(as_trained: float | None, psnr: float, effects: Effects) -> list[str]:
    """A note where a renderer of the base's training shows the base itself better than the file's viewer shows the file; none elsewhere."""
    if as_trained is None or as_trained <= psnr + HARM_DB:
        return []
    own = f"drawn as its training drew it ({effects.screen_filter} {effects.eps2d:g} px²), the base itself has {as_trained:.2f} dB"
    return [f"{own} on the same views, more than this file's {psnr:.2f}: for a renderer that draws so, adapt without a viewer"]


def worse_viewers(viewers: Iterable[str], before: Sequence[float], after: Sequence[float]) -> list[str]:
    """That a file for several viewers looks worse than the base in some of them, in a sentence; none where it does not, or is for one viewer.

    `before`, `after`: dB in each viewer as far as differences are visible.
    """
    worse = {name: (then, now) for name, then, now in zip(viewers, before, after, strict=True) if then > now + HARM_DB}
    if not worse or len(before) < 2:
        return []
    most = max(worse, key=lambda name: worse[name][0] - worse[name][1])
    then, now = worse[most]
    names = f"{' and '.join(worse)} {'show' if len(worse) > 1 else 'shows'}"
    where = f"of the {len(before)} viewers that it was chosen by, {names} the file worse than the base"
    told = f"{where}, by up to {then - now:.1f} dB as far as differences can be seen ({then:.1f} -> {now:.1f})"
    return [f"{told}: for such a viewer make a file of its own (--viewer {most})"]


def too_far_out(model: SplatModel, views: Sequence[Camera], targets: Mapping[str, Effects]) -> str:
    """That a viewer which keeps positions in 16 bits displaces most splats by more than their size, or loses them, in a sentence; "" if none does."""
    for viewer, effects in targets.items():
        positions = effects.settings.packing and in_two_steps(effects.settings.packing)[1]
        if not positions:
            continue
        splats = model.gaussians(views[0]).detach()
        splats = splats[:: max(1, len(splats) // SAMPLES)]
        moved = [(packed(splats, view, positions).means - splats.means).abs().amax(1) for view in evenly(views, LOOKED_AT)]
        share = float((torch.stack(moved) > splats.scales.abs().amax(1)).double().mean())
        if share > DISPLACED:
            where = f"{viewer} keeps positions in 16 bits, by which {share:.0%} of the splats are off by more than their size, or lost"
            return f"{where}; move the scene to the world's origin, with its cameras, or give another viewer"
    return ""
