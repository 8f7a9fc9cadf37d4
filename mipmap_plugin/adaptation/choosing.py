"""Choices before a run: the backend that a model is adapted with, and whether its splats are merged."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from mipmap_plugin.backends import choose_backend
from mipmap_plugin.backends.base import Backend, Needs
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.errors import BackendUnavailable, SettingsError
from mipmap_plugin.models.base import SplatModel


def choose(name: str, config: AdaptConfig, targets: Sequence[Needs], base: Needs) -> tuple[Backend, str, bool]:
    """The backend for these settings, why it was chosen, and whether it has gradients.

    `targets`: what the adapted model needs in each viewer; `base`: what the base needs. Raises BackendUnavailable, with what goes without
    gradients where these alone are lacking.
    """
    merges = config.merge_to < 1 or config.most_splats is not None
    try:
        backend, note = _choice(name, targets, base, gradients=config.steps > 0 or merges)
    except BackendUnavailable as error:
        try:
            _choice(name, targets, base, gradients=False)
        except BackendUnavailable:
            raise error from None
        way = 'recipe="instant" alone needs none'
        way += "" if config.steps else ", and neither does merge_to=1.0 without most_splats (--splats, --bytes)"
        raise BackendUnavailable(f"{error}; {'steps' if config.steps else 'merging'} cannot do without gradients: {way}") from None
    return backend, note, not any(backend.lacking(replace(need, gradients=True)) for need in targets)


def _choice(name: str, targets: Sequence[Needs], base: Needs, *, gradients: bool) -> tuple[Backend, str]:
    return choose_backend(name, *(replace(need, gradients=gradients) for need in targets), base)


def mergeable_settings(model: SplatModel, settings: dict[str, Any]) -> dict[str, Any]:
    """The settings (names of AdaptConfig), without merging where none of the splats can be merged. Raises SettingsError where it is asked for."""
    traits = model.traits
    if traits.same_for_all_views:
        return settings
    settings = settings if traits.thins else {"merge_to": 1.0, **settings}
    if settings.get("most_splats") or (not traits.thins and settings["merge_to"] < 1):
        reason = "its splats differ by view or time, so none are merged"
        raise SettingsError(f"{model.family}: {reason}; leave {'' if traits.thins else 'merge_to and '}most_splats (--splats, --bytes) out")
    return settings
