"""Which backends there are."""

import pytest

from mipmap_plugin.backends import BACKENDS


@pytest.fixture
def only_the_reference(monkeypatch):
    monkeypatch.setattr(BACKENDS, "_targets", {"reference": "mipmap_plugin.backends.reference:ReferenceBackend"})
