"""The manifest of a ladder, and the chunks of its splats."""

from mipmap_plugin.formats.streamed_sog import Chunk

CHUNKS = [Chunk((0, 0, 0), (2, 1, 1), (30, 2, 1)), Chunk((2, 0, 0), (4, 1, 1), (10, 3, 1))]

LADDER = {
    "base_pixel": 0.01,
    "view_pixel": 0.01,
    "middle": [0.0, 0.0, 0.0],
    "levels": [{"file": f"level_{number}.ply", "scale": 0.5**number, "splats": 60} for number in range(3)],
    "switches": [{"zoom": 0.7}, {"zoom": 0.35}],
}
