"""Adapt trained Gaussian-splatting checkpoints to another zoom, without their training images and without retraining."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mipmap_plugin.adaptation.target.upsamplers import register_upsampler as register_upsampler
    from mipmap_plugin.backends import register_backend as register_backend
    from mipmap_plugin.camera import Camera as Camera
    from mipmap_plugin.effects import Effects as Effects
    from mipmap_plugin.errors import MipmapPluginError as MipmapPluginError
    from mipmap_plugin.gaussians import Gaussians as Gaussians
    from mipmap_plugin.models import load_model as load_model
    from mipmap_plugin.models import register_model as register_model
    from mipmap_plugin.recipes import register_recipe as register_recipe
    from mipmap_plugin.scenes import load_scene as load_scene
    from mipmap_plugin.splatting.viewers import Viewer as Viewer
    from mipmap_plugin.splatting.viewers import register_viewer as register_viewer
    from mipmap_plugin.wrap import Adapted as Adapted
    from mipmap_plugin.wrap import Wrapped as Wrapped
    from mipmap_plugin.wrap import wrap_model as wrap_model

# Where each public name comes from. It is imported when it is first used: torch, which most need, takes over a second.
_HOME = {
    "Adapted": "wrap",
    "Camera": "camera",
    "Effects": "effects",
    "Gaussians": "gaussians",
    "MipmapPluginError": "errors",
    "Viewer": "splatting.viewers",
    "Wrapped": "wrap",
    "load_model": "models",
    "load_scene": "scenes",
    "register_backend": "backends",
    "register_model": "models",
    "register_recipe": "recipes",
    "register_upsampler": "adaptation.target.upsamplers",
    "register_viewer": "splatting.viewers",
    "wrap_model": "wrap",
}

__all__ = list(_HOME)


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
    except Exception as error:
        from mipmap_plugin.errors import PluginError
        from mipmap_plugin.registry import unreadable_package

        if reason := unreadable_package():
            raise PluginError(reason) from error
        raise


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOME})
