"""What is asked of an adaptation, beside its scale and its settings."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field

from torch import Tensor

from mipmap_plugin.adaptation.start.problem import FinerLevel
from mipmap_plugin.adaptation.target.base_images import BaseImages
from mipmap_plugin.adaptation.views.viewpoints import Viewpoints
from mipmap_plugin.camera import Camera, digest_of
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.effects import Effects
from mipmap_plugin.models.base import SplatModel, digest_of_model, digest_of_parameters

# (step, seconds of adapting so far, function that renders a camera of the new scale with the current model, without gradients)
# -> True (Python's, NumPy's or torch's) to end the run with this step, and anything else to go on. Its time is not counted.
Observer = Callable[[int, float, Callable[[Camera], Tensor]], object]


def ends_run(answer: object) -> bool:
    """Whether an observer's answer is True: Python's, NumPy's or torch's."""
    kind = answer is True or str(getattr(answer, "dtype", "")) in ("bool", "torch.bool")
    return kind and getattr(answer, "shape", ()) == () and bool(answer)


@dataclass(frozen=True)
class AdaptationRequest:
    """What is adapted, for which viewers, and by which backend."""

    images: BaseImages  # of the model, rendered as in its training, by the backend
    targets: Mapping[str, Effects]  # how the adapted file is rendered, by viewer; the file names the first of them
    viewer: str | None  # the viewer (or group of viewers) that the file is made for; None: what draws as the training did
    backend_note: str  # which backend was chosen, and why
    has_gradients: bool  # whether the backend has gradients for this request
    viewpoints: Viewpoints  # where generated views are
    base_in_viewer: SplatModel  # what the viewer reads of the base's own file: mostly the base itself
    finer: FinerLevel | None = None  # what the run starts from instead of the base
    inputs: Mapping[str, str] = field(default_factory=dict)  # `Report.inputs`
    budget_share: float = 1.0  # of the time budget that was asked for, which the settings have
    zoom_in: float | None = None  # of a conversion: the scale of the zoom-in that starts from what it returns, so that its state is kept

    @property
    def has_blend_weights(self) -> bool:
        """Whether splats are the same for all views, and the backend has the gradients that blend weights need."""
        return self.has_gradients and self.images.model.traits.same_for_all_views

    def fingerprint(self, scale: float, config: AdaptConfig, views: Sequence[Camera]) -> str:
        """A hash of everything that a run to `scale` depends on, so that a state is never resumed as another run."""
        base = digest_of_model(self.images.model) + ("" if self.finer is None else digest_of_parameters(self.finer.model))
        targets = [asdict(target) for target in self.targets.values()]
        by = [self.images.backend.name, asdict(self.images.effects), targets, digest_of(views)]
        return hashlib.sha256(json.dumps([base, dict(self.inputs), scale, config.model_dump(), *by]).encode()).hexdigest()
