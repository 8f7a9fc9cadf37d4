"""A base checkpoint as paths and options, from which any process can load it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from mipmap_plugin.errors import CheckpointError
from mipmap_plugin.process.garbage import uncollected

if TYPE_CHECKING:
    from mipmap_plugin.camera import Camera
    from mipmap_plugin.scenes import Scene
    from mipmap_plugin.wrap import Wrapped

COLORS = {None: None, "white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0)}


@dataclass(frozen=True)
class Base:
    """A checkpoint, and how it is to be read and rendered; the options are those of `wrap_model`."""

    checkpoint: Path
    cameras: Path | None = None  # a cameras.json, a transforms file or a COLMAP scene
    background: str | None = None  # "white" or "black"; None: as the checkpoint says
    backend: str = "auto"
    screen_filter: str | None = None
    up: str | None = None  # such as "z"; None: as the checkpoint says, if it does

    def asked(self, cameras: Sequence[Camera] | None = None) -> dict[str, str]:
        """What is given beside the checkpoint, as its adaptations record it, without loading it. `cameras`: its own (`own_cameras`), if they are read
        already. Raises CheckpointError, SceneError."""
        from mipmap_plugin.wrap import asked_for

        cameras = self.own_cameras() if cameras is None else cameras
        return asked_for(self._model_folder(), cameras, COLORS[self.background], self.screen_filter, self.up)

    def own_cameras(self) -> Sequence[Camera]:
        """The cameras that are given, or else those that the checkpoint has, without loading it. Raises CheckpointError, SceneError."""
        from mipmap_plugin.adaptation.views.cameras_of_base import own_cameras
        from mipmap_plugin.models import detect

        folder = self._model_folder()
        found = self._given_scene(folder) or own_cameras(detect(self.checkpoint).path, folder)[0]
        return found if isinstance(found, list) else found.cameras

    def photographs(self, path: Path) -> Scene:
        """The scene at `path`, to whose photographs the checkpoint is compared or adapted. Raises CheckpointError, SceneError."""
        from mipmap_plugin.models.inria_folder import read_options
        from mipmap_plugin.scenes import load_photographs

        return load_photographs(path, read_options(self._model_folder())[0])

    def unpacked(self) -> Base:
        """The same checkpoint, for another process: this one removes what it unpacked when it ends, but a worker that is killed does not."""
        from mipmap_plugin.models.zipped_folder import unzipped

        try:
            return replace(self, checkpoint=unzipped(self.checkpoint))
        except (CheckpointError, OSError):  # whoever loads it says so
            return self

    def load(self, threads: int | None = None, images: Path | None = None) -> Wrapped:
        """Load and wrap the checkpoint. Raises CheckpointError, SceneError, SettingsError, BackendUnavailable.

        `images`: the scene with whose photographs it is compared later, which is not done here if its cameras are theirs.
        """
        folder = self._model_folder()  # says what is wrong with the checkpoint before torch is imported
        with uncollected():
            from mipmap_plugin.wrap import WrapOptions, check_serves, wrap_model, wrap_unchecked

            check_serves(self.backend, threads)
            scene = self._given_scene(folder)  # before the splats, which take longer to read
            told: WrapOptions = {"background": COLORS[self.background], "screen_filter": self.screen_filter, "up": self.up}
            if scene is not None and self.cameras == images:
                return wrap_unchecked(self.checkpoint, scene, self.backend, threads, **told)[0]
            return wrap_model(self.checkpoint, cameras=scene, backend=self.backend, threads=threads, **told)

    def _model_folder(self) -> Path | None:
        """The folder of the training, also where the checkpoint is a file in it; None if there is none, or the format is not of a training."""
        from mipmap_plugin.models import detect

        found = detect(self.checkpoint)
        return None if found.family == "exchange" else found.folder

    def _given_scene(self, folder: Path | None) -> Scene | None:
        """The scene with the cameras that are given, read with the options of the model `folder`."""
        from mipmap_plugin.models.inria_folder import read_options
        from mipmap_plugin.scenes import load_scene

        return None if self.cameras is None else load_scene(self.cameras, read_options(folder)[0])
