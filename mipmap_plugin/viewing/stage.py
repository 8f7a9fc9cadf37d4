"""What is drawn, as data: the state of the page and a camera in, a picture and its figures out."""

from __future__ import annotations

from collections.abc import Container, Iterable
from dataclasses import dataclass, replace
from itertools import count

import torch
from torch import Tensor

from mipmap_plugin.adaptation.curve import Stopwatch, decibel
from mipmap_plugin.camera import Camera
from mipmap_plugin.models.base import means_at
from mipmap_plugin.viewing.screen import Sampling
from mipmap_plugin.viewing.sources import Request, Source, Supersampled
from mipmap_plugin.wrap import Wrapped

# Differences are multiplied by this, so that a step of one in a hundred is seen.
AMPLIFIED = 4.0


@dataclass(frozen=True)
class Look:
    """What the page is set to."""

    source: str  # name of what is shown
    against: str | None = None  # name of what it is compared with: the difference is shown; None: the picture itself
    viewer: str | None = None  # as which viewer draws; None: as in its training
    pixel: int = 1  # px of the screen along each side of a pixel of the picture
    time: float | None = None  # moment of a moving scene, 0..1; None: nothing moves


@dataclass(frozen=True, eq=False)
class Picture:
    """One picture, and its figures."""

    image: Tensor  # [H, W, 3], of the screen's size unless it is coarse
    drawn: Camera  # whose pixels were drawn
    zoom: float  # how finely the picture samples the scene, relative to the training
    shown: str  # what is shown, such as the level of a ladder
    seconds: float
    splats: tuple[int, int] | None  # inside the picture, and in all; None: not known
    psnr_db: float | None  # between the two pictures of a difference


class Stage:
    """The base and what is shown beside it, by name."""

    def __init__(self, base: Wrapped, others: Iterable[Source], reference: Supersampled) -> None:
        """`others`: the base itself among them; `reference`: what adapting aims at."""
        self.base, self.reference = base, reference
        views, self._device = base.views(), base.model.parameters()["means"].device
        self.sampling = Sampling(means_at(base.model, views[0]), views, base.effects().near_plane)
        self.sources: dict[str, Source] = {}
        for source in (*others, reference):
            self.add(source)

    def add(self, source: Source) -> str:
        """Show a further source, under a name that is free; return that name."""
        name = free_name(source.name, self.sources)
        self.sources[name] = source
        return name

    def camera(self, look: Look, screen: Camera) -> Camera:
        """The camera of the picture that a screen shows, with the zoom of its lens."""
        return self.sampling.with_lens(smaller(replace(screen, time=look.time), 1 / look.pixel))

    @torch.no_grad()
    def draw(self, look: Look, screen: Camera, coarse: float = 1.0) -> Picture:
        """Draw what a screen shows; `coarse`: the fraction of its width and height that is drawn. Raises SettingsError, BackendUnavailable."""
        camera = self.camera(look, screen)
        zoom = self.sampling.of(camera).zoom
        drawn = smaller(camera, coarse)
        request = Request(drawn, zoom, look.viewer, drawn.height / camera.height if coarse < 1 else 1.0)
        source = self.sources[look.source]
        with Stopwatch(self._device) as watch:
            image, psnr_db = source.render(request).clamp(0, 1), None
            if look.against is not None:
                difference = image - self.sources[look.against].render(request).clamp(0, 1)
                image, psnr_db = (AMPLIFIED * difference.abs()).clamp(0, 1), decibel(float(difference.square().mean()))
        enlarged = whole_pixels(image, look.pixel, screen) if coarse == 1 else image
        return Picture(enlarged, drawn, zoom, source.shown(zoom), watch.seconds, source.splats(request), psnr_db)


def free_name(name: str, taken: Container[str]) -> str:
    """The name, with a number behind it where it is taken."""
    return name if name not in taken else next(each for number in count(2) if (each := f"{name} ({number})") not in taken)


def smaller(camera: Camera, factor: float) -> Camera:
    """The same field of view with `factor` times as many pixels along each axis, at least one."""
    return camera if factor == 1 else camera.resized(max(1, round(camera.width * factor)), max(1, round(camera.height * factor)))


def whole_pixels(image: Tensor, pixel: int, screen: Camera) -> Tensor:
    """The image [h, w, 3] with each pixel enlarged to `pixel` x `pixel`, and the last row and column repeated up to the screen's size."""
    if pixel == 1:
        return image
    rows = (torch.arange(screen.height) // pixel).clamp_max(image.shape[0] - 1)
    columns = (torch.arange(screen.width) // pixel).clamp_max(image.shape[1] - 1)
    return image[rows.to(image.device)][:, columns.to(image.device)]
