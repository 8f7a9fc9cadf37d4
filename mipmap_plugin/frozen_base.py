"""A frozen base model with its cameras, which is rendered and adapted to other scales. It never changes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, cast

import torch
from typing_extensions import TypedDict, Unpack

from mipmap_plugin.adaptation import notebook
from mipmap_plugin.adaptation.adapted import Adapted, as_start, render_model
from mipmap_plugin.adaptation.choosing import choose, mergeable_settings
from mipmap_plugin.adaptation.conversion import Stages, conversion
from mipmap_plugin.adaptation.near_planes import NearPlanes
from mipmap_plugin.adaptation.portable import settings_for_several
from mipmap_plugin.adaptation.request import AdaptationRequest, Observer
from mipmap_plugin.adaptation.start.problem import FinerLevel
from mipmap_plugin.adaptation.target.base_images import LIMIT, BaseImages
from mipmap_plugin.adaptation.target.photographs import Photographs, scene_of
from mipmap_plugin.adaptation.target.upsamplers import network_input
from mipmap_plugin.adaptation.views.placing import placed
from mipmap_plugin.adaptation.views.policy import choose_views
from mipmap_plugin.adaptation.views.refusals import refuse_blind, refuse_large
from mipmap_plugin.adaptation.views.viewpoints import ClearViews, Viewpoints, orbit_of
from mipmap_plugin.backends import choose_backend
from mipmap_plugin.backends.base import Backend, Needs, Rendered
from mipmap_plugin.camera import ONE_PIXEL, Camera, checked, digest_of, of_base_scale
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.effects import Effects, as_outputs
from mipmap_plugin.errors import BackendUnavailable, SettingsError
from mipmap_plugin.formats.atomic import named, refuse_output, refuse_unwritable
from mipmap_plugin.formats.readers import refuse_unread
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.limits import check_image, check_kinds, check_names, check_scale, path_of
from mipmap_plugin.models.base import Filtered, SplatModel, TrainedScale, tensors_of, why_no_viewer
from mipmap_plugin.models.contract import checked_splats
from mipmap_plugin.models.mip import filter_3d_of, smooth_3d
from mipmap_plugin.models.outputs import parts_of
from mipmap_plugin.models.places import REPORT, state_path
from mipmap_plugin.plugin_errors import naming_any, unchanged
from mipmap_plugin.process import threads
from mipmap_plugin.process.torch_modes import in_usual_modes
from mipmap_plugin.recipes import recipe as make_config
from mipmap_plugin.scenes import Scene
from mipmap_plugin.screen_filters import DILATION, USUAL_EPS2D, check_screen_filter
from mipmap_plugin.splatting.filters import INTEGRALS
from mipmap_plugin.splatting.viewers import find_viewer, own_name, viewers_for


class RenderOptions(TypedDict, total=False):
    """Further options of `FrozenBase.render`."""

    viewer: str | None  # render as this viewer does, instead of with a screen filter; without a filter_3D if it does not read it
    filter_3d: bool  # first smooth every splat to the finest detail that the cameras could resolve (Mip-Splatting's 3D filter)
    outputs: Sequence[str]  # "depth" and "normals", besides the image (`Rendered`)
    clamped: bool  # clamp the samples of a pixel to 0..1 before they are averaged, as evaluations do
    exposure: bool  # apply the exposure of the photograph that the camera is named after, if exposure.json has it


class FrozenBase:
    """A frozen base model with its cameras: what levels build on. `wrap.Wrapped` can make them, too."""

    def __init__(self, model: SplatModel, cameras: Sequence[Camera], backend: str, trained: TrainedScale, threads: int | None = None) -> None:
        self.model, self.cameras, self._backend, self.trained, self.threads = model, list(cameras), backend, trained, threads
        self.background = trained.background or (0.0, 0.0, 0.0)
        self.loading_s = 0.0  # seconds that loading the model took
        self.asked: dict[str, str] = {}  # what was given beside the checkpoint (`Report.inputs`); "" for what was not
        self.cameras_from: dict[str, str] = {}  # where its cameras were read from (`Report.cameras_from`)
        self.compared = set[tuple[Path, bytes]]()  # the photographs that it was compared with (`Scene.photographed`)
        self.images: BaseImages | None = None  # of the base, drawn so far for all scales; None: the next call draws all of its own
        self.keeps_images = True  # for further scales, up to 1 GiB; False saves that memory where `adapt` is called once

    def __repr__(self) -> str:
        return notebook.line(type(self).__name__, notebook.base_facts(self.model, self.cameras, self.trained))

    def _repr_html_(self) -> str:
        facts = notebook.base_facts(self.model, self.cameras, self.trained)
        return notebook.table(type(self).__name__, facts, lambda camera: self.render(camera).image, self.views()[0])

    def effects(self, scale: float = 1.0, screen_filter: str | None = None, supersampling: int = 1, viewer: str | None = None) -> Effects:
        """How this model is rendered at `scale`, or by the viewer of that name (`splatting.viewers`).

        `screen_filter`: None for the filter of its training, a filter's name, or "scaled" for the training-free filter whose dilation keeps its
        size in the world. Filters that integrate over the pixel dilate splats so, too: a classic model was trained to look right with dilation.
        The near plane of a small scene without cameras holds for all. Raises SettingsError for an unknown viewer or filter, and for both together.
        """
        check_kinds(screen_filter=(screen_filter, str))
        trained = self.trained
        own = Effects(self._needs.sh_degree, trained.screen_filter, trained.eps2d, self.background, supersampling, trained.near_plane)
        if viewer is not None:
            if screen_filter is not None:
                raise SettingsError(f"viewer {viewer} has a screen filter of its own; leave the screen filter {screen_filter} out")
            drawn = find_viewer(viewer).effects(own)
            return drawn if own.near_plane >= self.model.trained.near_plane else replace(drawn, near_plane=min(drawn.near_plane, own.near_plane))
        if screen_filter is None:
            return own
        scaled = replace(own, eps2d=trained.eps2d * scale**2)
        if screen_filter == "scaled":
            return scaled
        check_screen_filter(screen_filter, "scaled", trained.screen_filter)
        if screen_filter in INTEGRALS and trained.screen_filter == "classic":
            return replace(scaled, screen_filter=screen_filter)
        return replace(own, screen_filter=screen_filter, eps2d=USUAL_EPS2D.get(screen_filter, DILATION))

    def backend(self, *, gradients: bool = False, screen_filter: str | None = None, viewer: str | None = None) -> tuple[Backend, str]:
        """Return the backend that renders this model, and why it was chosen."""
        effects = self.effects(screen_filter=screen_filter, viewer=viewer)
        needs = replace(self._needs, gradients=gradients, screen_filter=effects.screen_filter, settings=effects.settings)
        return choose_backend(self._backend, needs)

    def lacks(self, screen_filter: str) -> str:
        """Why this model's backend does not have a screen filter, in a sentence; "" if it does."""
        try:
            self.backend(screen_filter=screen_filter)
        except BackendUnavailable as error:
            return str(error)
        return ""

    @in_usual_modes
    def render(
        self, camera: Camera, scale: float = 1.0, screen_filter: str | None = None, supersampling: int = 1, **options: Unpack[RenderOptions]
    ) -> Rendered:
        """Render the base model's view of `camera`, which samples `scale` times as finely as the training did.

        `screen_filter`: as in `effects`. `supersampling`: samples per pixel along each axis. `options`: `RenderOptions`. Raises SettingsError,
        BackendUnavailable, PluginError.
        """
        [camera], outputs = checked([camera]), as_outputs(options.get("outputs"))
        check_names("render", options, RenderOptions, ("scale", "screen_filter", "supersampling"))
        viewer, exposure = options.get("viewer"), options.get("exposure", False)
        effects = replace(self.effects(check_scale(scale), screen_filter, supersampling, viewer), outputs=outputs, exposure=exposure)
        check_image(camera.width * supersampling, camera.height * supersampling, self.model.parameters()["means"].device)
        backend, _ = self.backend(screen_filter=screen_filter, viewer=viewer)
        form = self._smoothed if options.get("filter_3d") else None
        with threads.limited_for(backend, self.threads):
            return render_model(self.read_by(viewer), backend, camera, effects, form, options.get("clamped", False))

    def _smoothed(self, gaussians: Gaussians) -> Gaussians:
        """Apply Mip-Splatting's 3D filter. Raises SettingsError without cameras, and for splats that it cannot be applied to."""
        if not self.cameras:
            raise SettingsError("the 3D filter is computed from the cameras, and this checkpoint has none; give --cameras")
        if gaussians.covariances is not None or self.model.traits.filtered:
            raise SettingsError(f"{self.model.family}: its splats have covariances instead of scales, or a 3D filter already; leave filter_3d out")
        scales, opacities = smooth_3d(gaussians.scales, gaussians.opacities, filter_3d_of(gaussians.means, self.cameras))
        return replace(gaussians, scales=scales, opacities=opacities)

    @in_usual_modes
    def adapt(
        self,
        scale: float,
        *,
        recipe: str = "default",
        viewer: str | None = None,
        cameras: Sequence[Camera] | None = None,
        resume: str | Path | None = None,
        observe: Observer | None = None,
        images: Scene | str | Path | None = None,
        start: FinerLevel | Adapted | None = None,
        **settings: Any,
    ) -> Adapted:
        """Return a new model for `scale` (target focal length in px over base focal length in px); the base does not change.

        `viewer`: the viewer that the file will be opened in (`splatting.viewers`), or "portable" for all built-in ones at once; by
        default renderers that draw as the training did.
        `cameras`: views of the base scale, instead of the checkpoint's own. `settings` override those of the recipe, by the names
        of AdaptConfig: steps, time_budget_s, target_db, seed, views, ... `resume`: a file to continue from if it exists; Ctrl-C writes it
        and raises Interrupted, unless the program has a handler of its own, which is called; a long run writes it every minute, and saving the
        model removes it. `observe(step, seconds, render)` is called before the first step and after each (of the conversion before a zoom-in,
        too: `adaptation.conversion`); `render(camera)` is the current image [H, W, 3], without gradients, and the run ends where it returns True.
        `images`: a scene, or its path, whose training images are the truth of a zoom-in, instead of the base's renders of these views.
        `start`: a model adapted from this base for the same viewer to a finer scale, to start from instead of from the base. While it runs, torch's
        default dtype is float32, and torch may have one thread, in the whole process: torch has one of each.
        Raises SettingsError, SceneError, BackendUnavailable, PluginError.
        """
        scale, cameras = check_scale(scale), None if cameras is None else of_base_scale(cameras, some=True)
        check_kinds(observe=(observe, Callable))
        scene = None if images is None else scene_of(self.model, images)
        state = None if resume is None else path_of(resume, "resume")
        model = self._fused if viewer is not None and self.model.traits.filtered else self.model
        finer = as_start(start, viewer, scale, model)
        if scene and self.model.traits.exposures.changed:
            raise SettingsError("the images were exposed differently, which adaptation does not support (exposure.json); leave them out")
        there = self.place(scene) if scene else None
        config, targets = self._planned(recipe, scale, viewer, mergeable_settings(model, settings), cameras or ())
        first = conversion(config, self.effects(), targets.values(), scale) if finer is None else None
        views = {} if cameras is None else {"views": digest_of(cameras)}
        inputs = self.asked | views | ({"photographs": scene.digest()} if scene else {}) | network_input(config.upsampler)
        photographs = Photographs(there, self.cameras, self.background) if there else None
        if photographs:
            photographs.warn_of_others(self.render, self.compared)
        cameras = (photographs or self).cameras if cameras is None else cameras
        needs = [replace(self._needs, screen_filter=target.screen_filter, settings=target.settings) for target in targets.values()]
        backend, note, has_gradients = choose(self._backend, config, needs, self._needs)
        if config.steps:
            refuse_large(cameras or self.views(), self.model, scale)
        base_in_viewer = model if (in_viewer := self.read_by(viewer)) is self.model else in_viewer
        base_images = self._base_images(model, backend, self.keeps_images or first is not None)
        request = AdaptationRequest(base_images, targets, viewer, note, has_gradients, self.viewpoints, base_in_viewer, finer, inputs)
        family, theirs = f"family {model.family!r}", {f"backend {backend.name!r}": getattr(backend, "theirs", backend)}
        alone = threads.limited_for(backend, self.threads)
        with alone, torch.enable_grad(), naming_any({family: model, **theirs}), unchanged(family, tensors_of(model)):
            stages = Stages(request, list(cameras), photographs, state, observe)
            adapted = stages.adapt(scale, config, first)
        adapted.report.seconds["loading"] = self.loading_s
        adapted.report.cameras_from.update(self.cameras_from)
        return replace(adapted, cameras=self.views())

    def _planned(
        self, recipe: str, scale: float, viewer: str | None, settings: dict[str, Any], cameras: Sequence[Camera]
    ) -> tuple[AdaptConfig, dict[str, Effects]]:
        """The settings of an adaptation, and `targets`."""
        config, targets = make_config(recipe, scale, **settings), self.targets(viewer, cameras)
        return config if len(targets) == 1 else make_config(recipe, scale, **(settings_for_several(config) | settings)), targets

    def _base_images(self, model: SplatModel, backend: Backend, keep: bool) -> BaseImages:
        """Those that are drawn already, or none yet: of another base. `keep`: for further scales and stages."""
        if self.images is None or not self.images.are_of(model, backend, self.effects()):
            self.images = BaseImages(model, backend, self.effects(), LIMIT if keep else 0)
        return self.images

    def refuse_output(self, path: str | Path, *, overwrite: bool, networks_move: bool = True, viewer: str | None = None) -> None:
        """Raise now the error that saving a model adapted for `viewer` to `path` would raise at the end, as far as it can be predicted."""
        source, parts = self.model.source, parts_of(self.model.source, self.model.folder)
        model = cast(Filtered, self.model).bare() if viewer is not None and self.model.traits.filtered else self.model
        refuse_unread(path := path_of(path), [own_name(name) for name in viewers_for(viewer)] if viewer else [])
        with naming_any({f"family {model.family!r}": model}):
            model.refuse_output(path, overwrite=overwrite, networks_move=networks_move)
        refuse_output(named(path).with_name(named(path).name + REPORT), overwrite, parts, is_file=True)
        refuse_output(state_path(path), True, parts, is_file=True)
        refuse_unwritable(path, 0 if source is None else source.stat().st_size)

    def targets(self, viewer: str | None, cameras: Sequence[Camera] = ()) -> dict[str, Effects]:
        """How an adapted file for `viewer` is rendered, by viewer: several for "portable", and one named "" for None.

        Where `cameras`, by default the base's `views`, see no difference of a viewer from the base's training, the file is rendered as that did.
        Raises SettingsError for a model whose splats no viewer renders.
        """
        if viewer is None:
            return {"": self.effects()}
        if reason := why_no_viewer(self.model):
            raise SettingsError(f"{self.model.family}: {reason}; leave the viewer {viewer} out")
        return {name: self._near_planes.target(self.effects(viewer=name), lambda: cameras or self.views()) for name in viewers_for(viewer)}

    @cached_property
    def _near_planes(self) -> NearPlanes:
        return NearPlanes(self.model, self.effects(), partial(choose_backend, self._backend, self._needs))

    def target(self, viewer: str | None) -> Effects:
        """How the adapted file is rendered. Raises SettingsError as `targets` does, and for the name of a group of viewers."""
        if viewer is not None:
            find_viewer(viewer)
        return self.targets(viewer)[viewer or ""]

    @cached_property
    def _fused(self) -> SplatModel:
        """The base with its 3D filter baked into plain splats, for viewers."""
        return cast(Filtered, self.model).fused()

    def read_by(self, viewer: str | None) -> SplatModel:
        """The base as a viewer reads its file: without its 3D filter if the viewer does not read it."""
        reads_all = viewer is None or not self.model.traits.filtered or all(find_viewer(name).filter_3d for name in viewers_for(viewer))
        return self.model if reads_all else cast(Filtered, self.model).bare()

    @in_usual_modes
    def views(self) -> list[Camera]:
        """The checkpoint's cameras, or a generated orbit, for an adapted file that of its base, if it came without any."""
        return self.cameras or choose_views([], replace(self.viewpoints, clear=list, finer=False), AdaptConfig())[0]

    @cached_property
    def viewpoints(self) -> Viewpoints:
        """Where views without cameras are. Raises SettingsError without splats."""
        clear = ClearViews(self.model, partial(choose_backend, self._backend, self._needs), self.effects())
        return Viewpoints(orbit_of(self.model, self.trained, lone=not self.cameras), clear)

    def refuse_undrawn(self, views: Sequence[Camera] | None = None, scale: float = 1.0) -> None:
        """Raise SettingsError if none of the views, by default the base's own, shows anything of it at `scale` (`refuse_blind`)."""
        scale, views = check_scale(scale), self.views() if views is None else checked(views, some=True)
        refuse_blind(views, self.model, self.effects().near_plane, lambda view: self.render(view).image, scale)

    def place(self, scene: Scene) -> Scene:
        """Return the scene in the model's frame (`placed`); a checkpoint that came without cameras gets those of the scene."""
        in_frame = placed(self.model, scene := scene_of(self.model, scene), self.cameras)
        if in_frame is not scene and not self.cameras:
            self.cameras = list(in_frame.cameras)
        return in_frame

    @cached_property
    def _needs(self) -> Needs:
        """What the base needs of a backend; computed once, because the base never changes."""
        with torch.no_grad(), naming_any({f"family {self.model.family!r}": self.model}):
            gaussians = checked_splats(self.model, self.any_camera())
        return Needs.of(gaussians, Effects(gaussians.used_sh_degree(), self.trained.screen_filter), gradients=False)

    def any_camera(self) -> Camera:
        """One of the cameras, or a camera of one pixel if there are none."""
        return self.cameras[0] if self.cameras else ONE_PIXEL
