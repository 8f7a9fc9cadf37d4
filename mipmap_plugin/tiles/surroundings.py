"""What a tile is drawn with: the halo, which is all other tiles as a sweep begins. It is frozen, neither merged nor moved.

With the transmittance T of what is in front of the core and the picture B of what is behind it, the core's own picture c and transmittance
t make the view V = T (c + t B) and what is in front. As the sweep begins, the view is the exact picture of all splats; later it is that
picture and the change of T (c + t B) since then.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from threading import Lock
from typing import ClassVar

import torch
from torch import Tensor

from mipmap_plugin.adaptation.optimization.activation import WithGradients
from mipmap_plugin.adaptation.parallel import VIEWS_AT_ONCE
from mipmap_plugin.adaptation.renderers import Comparison, SteppingRenderer
from mipmap_plugin.adaptation.target.image_store import from_16_bits
from mipmap_plugin.backends.base import Rendered, Stepper
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.tiles.folder import halo_file, layer_file
from mipmap_plugin.tiles.halo import FINE, on_black, within
from mipmap_plugin.tiles.pictures import Album
from mipmap_plugin.tiles.scene import TiledScene
from mipmap_plugin.tiles.sweeps import Sweep
from mipmap_plugin.tiles.truth import Truths, parts

# Views whose surroundings are kept: those of a step are needed twice.
KEPT = 2 * VIEWS_AT_ONCE

# The name of a view that does not show the core.
NOTHING = "nothing"


@dataclass(frozen=True, eq=False)
class _Surrounding:
    """The halo in the core's box [h, w] of one view."""

    rest: Tensor  # [h, w, 3]: what has to be added to T (c + t B)
    through: Tensor  # [h, w, 1]: T
    behind: Tensor  # [h, w, 3]: T B
    wanted: Tensor  # [h, w, 3]: what the box should look like


class Surroundings:
    """The halo of a tile in a sweep's views; with splats of the core and a crop's camera, it renders both together."""

    def __init__(self, scene: TiledScene, number: int, sweep: Sweep) -> None:
        self._scene, self._number = scene, number
        self._effects = on_black(scene.target)
        self._truths = Truths(scene)
        self._layers = Album([layer_file(scene.folder, number, sweep.halos)])
        self._halos = Album(halo_file(scene.folder, part, sweep.halos) for part in range(parts(scene.sweep_views(sweep))))
        self._kept: dict[str, _Surrounding] = {}
        self._lock = Lock()  # views are asked for side by side

    def crop(self, view: Camera) -> Camera | None:
        """The core's box, at the new scale, in a view of the base; None if it shows too little of the core."""
        name = f"{view.name}/{self._number}"
        if name not in self._halos:
            return None
        left, top, right, bottom = self._halos.box(name)
        target = view.zoomed(self._scene.scale)
        return replace(target, width=right - left, height=bottom - top, cx=target.cx - left, cy=target.cy - top)

    def _surrounding(self, name: str) -> _Surrounding:
        with self._lock:
            if name not in self._kept:
                self._kept[name] = self._read(name)
                if len(self._kept) > KEPT:
                    del self._kept[next(iter(self._kept))]
            return self._kept[name]

    def _read(self, name: str) -> _Surrounding:
        own = f"{name}/{self._number}"
        through, behind, share = (self._halos[own].float() / FINE).split((1, 3, 1), dim=2)
        left, top, right, bottom = box = self._halos.box(own)
        image, truth = within(from_16_bits(self._halos[name]), box), within(self._truths[name], box)
        x, y, *_ = self._layers.box(name)
        before = within(self._layers[name], (left - x, top - y, right - x, bottom - y)).float()
        core = through * before[..., :3] + before[..., 3:] * behind
        return _Surrounding(image - core, through, behind, truth + (1 - share) * (image - truth))

    def render(self, core: Gaussians, camera: Camera) -> Tensor:
        """The image [h, w, 3] of a crop, differentiable in the core's splats."""
        return self.whole(camera, self._scene.backend.render(core, camera, self._effects))

    def render_views(self, core: Gaussians, cameras: Sequence[Camera], _: int = 0) -> list[Tensor]:
        """The same of several cameras, in one call if the backend can."""
        together = getattr(self._scene.backend, "render_views", None)
        shown = [camera for camera in cameras if camera.name != NOTHING] or cameras[:1]  # one at least, so that every step has gradients
        shots = [(camera, self._effects) for camera in shown]
        drawn = [self._scene.backend.render(core, *shot) for shot in shots] if together is None or len(shots) < 2 else together(core, shots)
        wholes = {camera: self.whole(camera, picture) for camera, picture in zip(shown, drawn, strict=True)}
        return [wholes[camera] if camera in wholes else 0 * wholes[shown[0]][:1, :1] for camera in cameras]

    @property
    def to_step(self) -> SteppingRenderer | None:
        """What draws the steps of the core, if the backend moves splats itself."""
        usual = SteppingRenderer.of(self._scene.backend, [self._effects])
        return None if usual is None else _InHalo(usual.stepper, usual.targets, self)

    def whole(self, camera: Camera, core: Rendered) -> Tensor:
        """The image [h, w, 3] of a camera, in which the core looks like this."""
        if camera.name == NOTHING:
            return 0 * core.image
        around = self._surrounding(camera.name)
        return around.rest + around.through * core.image + (1 - core.alpha)[..., None] * around.behind

    def wanted(self, camera: Camera) -> Tensor:
        """[h, w, 3]: what a crop should look like, in front of, behind and among a halo that is not right yet either.

        The other tiles learn too, and each pixel's error must not be mended once by every tile that it shows: a tile mends the fraction
        of the error that it has of the pixel's blend weights. All tiles together then mend all of it, to first order.
        """
        return self._surrounding(camera.name).wanted if camera.name != NOTHING else torch.zeros(1, 1, 3)


@dataclass(frozen=True)
class _InHalo(SteppingRenderer):
    """Draws a core with its surroundings by the backend's stepper, which moves the core's splats afterwards."""

    around: Surroundings
    together: ClassVar[bool] = False

    def differentiate_one(self, stepper: Stepper, number: int, shot: tuple[Camera, Effects], compare: Comparison) -> Tensor:
        """See `SteppingRenderer`. The first view of a step is drawn whatever it shows, so that every step has gradients."""
        camera, _ = shot
        if camera.name == NOTHING and number > 0:
            return torch.zeros(())
        core = stepper.render(number, *shot)
        image, alpha = core.image.requires_grad_(), core.alpha.requires_grad_()
        whole = self.around.whole(camera, core)
        [(gradient, square_error)] = compare([number], [whole.detach()])
        WithGradients.apply([gradient], whole).backward()  # type: ignore[no-untyped-call]  # torch's
        assert image.grad is not None  # since the whole contains it
        stepper.differentiate(number, image.grad, alpha.grad)
        return square_error


def nothing(view: Camera) -> Camera:
    """What stands for a view that does not show the core. In a step all tiles take the same views, and each draws what it has in them."""
    return replace(view, width=1, height=1, name=NOTHING)
