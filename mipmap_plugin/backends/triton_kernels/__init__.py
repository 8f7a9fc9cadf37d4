"""The Triton backend's kernels: projection, binning and compositing, each with its backward pass.

Nothing here needs more than compute capability 7.5: plain loads, stores and float32 atomics. Numbers that shape the work are below,
with their reasons; none of them changes an image, and none has been tuned on a GPU.
"""

# px. A program draws one tile. 16 x 16 is what every peer's tile is: 8 x 8 would halve the wasted pixels and double the pairs to sort.
TILE = 16

# Splats between two questions whether any pixel of a tile is still open. Their loads can be under way together; more of them cost registers.
FORWARD_BATCH = 4
BACKWARD_BATCH = 2

# Warps that draw a tile. One spends 23 instructions on a (splat, pixel) pair, four spend 35 (counted in the code for compute capability
# 8.0); but one warp a tile leaves most of a GPU idle where there are few tiles, and 17 of them fill a multiprocessor's registers.
MANY_TILES = 4096
WARPS_OF_MANY, WARPS_OF_FEW = 1, 4

# Splats per program where each is worked on alone: small blocks, for a thread holds over a hundred numbers at once.
SPLATS = 128

# (splat, tile) pairs per program where each is worked on alone.
PAIRS = 512

# x, y, falloff along y, shear, falloff across, log2 of opacity, red, green, blue: `records.py`.
RECORD = 9
