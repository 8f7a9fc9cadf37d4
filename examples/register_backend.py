"""Register your own rasterizer, and check it with the conformance suite.

A package registers its backend without any call, by an entry point in its pyproject.toml:

    [project.entry-points."mipmap_plugin.backends"]
    careful = "my_package.careful:CarefulBackend"

and tests it in one file, test_careful.py, where every hard case becomes a pytest test:

    from mipmap_plugin.backends.conformance.suite import BackendSuite

    class TestCareful(BackendSuite):
        backend = CarefulBackend()
"""

from __future__ import annotations

import torch

from mipmap_plugin.backends import get_backend, register_backend
from mipmap_plugin.backends.base import API_VERSION, Capabilities, Needs, Rendered
from mipmap_plugin.backends.conformance import check_backend, summary
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.gaussians import Gaussians


class CarefulBackend:
    """Renders float32 splats in float64."""

    name = "careful"
    api_version = API_VERSION
    speed = -1  # never chosen by `auto`
    capabilities = Capabilities(devices=frozenset({"cpu"}), dtypes=frozenset({torch.float32}), screen_filters=frozenset({"classic"}))

    def lacking(self, needs: Needs) -> list[str]:
        return self.capabilities.lacking(needs)

    def render(self, gaussians: Gaussians, camera: Camera, effects: Effects) -> Rendered:
        rendered = ReferenceBackend().render(gaussians.to(dtype=torch.float64), camera, effects)
        return Rendered(rendered.image.to(gaussians.means.dtype), rendered.alpha.to(gaussians.means.dtype))


if __name__ == "__main__":
    register_backend("careful", CarefulBackend)
    outcomes = check_backend(get_backend("careful"))
    for outcome in outcomes:
        result = "skipped" if outcome.skipped else "passed" if outcome.passed else "FAILED"
        print(f"{outcome.case:45} {result:8} {outcome.max_error:8.1e}  {outcome.message}")
    print(summary(outcomes))
