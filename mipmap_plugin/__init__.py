"""Adapt trained Gaussian-splatting checkpoints to another zoom, without their training images and without retraining."""

from mipmap_plugin.adaptation.target.upsamplers import register_upsampler
from mipmap_plugin.backends import register_backend
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.errors import MipmapPluginError
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.models import load_model, register_model
from mipmap_plugin.recipes import register_recipe
from mipmap_plugin.scenes import load_scene
from mipmap_plugin.splatting.viewers import Viewer, register_viewer
from mipmap_plugin.wrap import Adapted, Wrapped, wrap_model

__all__ = [
    "Adapted",
    "Camera",
    "Effects",
    "Gaussians",
    "MipmapPluginError",
    "Viewer",
    "Wrapped",
    "load_model",
    "load_scene",
    "register_backend",
    "register_model",
    "register_recipe",
    "register_upsampler",
    "register_viewer",
    "wrap_model",
]
