"""The size of a small screen of the live view, and a run for it."""

from mipmap_plugin.viewing.adapting import Wish

SIZE = (48, 64)  # height, width


def wish(base, scale=1 / 2, **changes):
    screen = base.cameras[0].zoomed(scale)
    return Wish(**{"screen": screen, "look_at": (0.0, 0.0, 0.0), "zoom": scale, "viewer": None, "seconds": 30.0, "recipe": "default", **changes})
