"""Ladders: what is warned of."""

import pytest
import torch
from brief_levels import request, wrapped

from mipmap_plugin.adaptation.start.base_weights import note_on_hidden
from mipmap_plugin.adaptation.warn import held, warn
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.frozen_base import FrozenBase
from mipmap_plugin.levels.ladder import NO_FEWER, make_levels

pytestmark = pytest.mark.usefixtures("brief_ladders", "few_views")


def test_only_of_levels_that_are_kept_is_anything_warned(monkeypatch, recwarn):
    base, adapt = wrapped(), FrozenBase.adapt

    def warning(self, scale, **options):
        warn(f"x{scale:g} looks worse")
        return adapt(self, scale, **options)

    monkeypatch.setattr(FrozenBase, "adapt", warning)
    monkeypatch.setattr("mipmap_plugin.levels.ladder._no_use", lambda level, *_: NO_FEWER if 0.4 < level.band.scale < 0.6 else None)
    ladder = make_levels(base, request())
    assert [left.scale for left in ladder.contents.left_out] == pytest.approx([1 / 2])
    assert [str(each.message) for each in recwarn if "looks worse" in str(each.message)] == ["x1 looks worse", "x0.25 looks worse"]


def test_that_no_view_shows_many_splats_is_told_of_one_level(monkeypatch, recwarn):
    """Each level has another part of them, as merging leaves what no view shows."""
    base, adapt = wrapped(), FrozenBase.adapt

    def hidden(self, scale, **options):
        for note in note_on_hidden(torch.arange(100) > 60 / scale**0.1, torch.ones(100)):
            warn(note)
        return adapt(self, scale, **options)

    monkeypatch.setattr(FrozenBase, "adapt", hidden)
    assert len(make_levels(base, request()).levels) > 1
    assert [str(each.message)[:35] for each in recwarn if "no view shows" in str(each.message)] == ["no view shows 61% of the splats, of"]


def test_what_a_level_that_fails_warned_of_is_told(recwarn):
    with pytest.raises(SettingsError), held():
        warn("the cameras may be of another scene")
        raise SettingsError("nothing is drawn")
    assert [str(each.message) for each in recwarn] == ["the cameras may be of another scene"]
