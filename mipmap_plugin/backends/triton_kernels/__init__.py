"""The Triton backend's kernels: projection, binning and compositing, each with its backward pass.

Memory layout. V views of N splats are drawn at once; all arrays are contiguous, and `d_x` is the gradient of the loss with respect to `x`.

    splat n:             means [N, 3]  quats [N, 4]  scales [N, 3] (or covariances [N, 3, 3])  opacities [N]  sh [N, BANDS, 3]
                              |
                              v  project_kernel, a lane per splat and view
    splat v · N + n:     records [V · N, 9]: | x | y | along | shear | across | log2 opacity | red | green | blue |     depths [V · N]
                         boxes [V · N, 4]:   | first tile_x | first tile_y | width in tiles | number of tiles |
                              |
                              v  sort by depth, emit_kernel, stable sort by tile: one (splat, tile) pair per tile of a box
    pair p:              splat_ids [P]:  | tile 0, front to back | tile 1, front to back | ... | pairs in no tile |
                                         ^                       ^                             ^
                         tile_offsets:   0                       1                             V · tiles      [V · tiles + 1]
                              |
                              v  composite_kernel, a program per tile and view; round_kernel, where a viewer rounds pictures
    pixel (v, y, x):     images [V, pixels, 3]  transmittances [V, pixels]; `tiles` and `pixels` are those of the largest view

composite_back_kernel adds the gradients of a tile's pixels to d_records [V · N, 9]. With deterministic sums it writes one row per pair
instead; the pairs of a splat lie side by side there, and gather_kernel sums them in order. color_back_kernel and project_back_kernel do the
rest, view after view, and adam_kernel moves the splats, where no other module needs the gradients (`stepping.py`).

Compute capability 7.5 suffices: plain loads, stores and float32 atomics. The constants below set how work is divided; none of them
changes an image.
"""

# px. A program renders one tile. Large tiles share what each pair costs; small ones waste fewer pixels, and give small images, which show
# thousands of splats in a tile, more and shorter lists: up to this number of pixels, in all views that are drawn at once, tiles are small.
SMALL_TILE, LARGE_TILE = 4, 8
PIXELS_OF_SMALL = 1 << 18

# Splats of a tile whose loads and sums overlap: more hide more latency, but need registers, which are few where tiles are many. One warp per
# tile, so that sums over it need no barrier.
BATCH = 4
BACK_BATCH = {SMALL_TILE: 4, LARGE_TILE: 2}
WARPS = 1

# Splats per program in kernels with a lane per splat: small blocks, for a thread holds over a hundred numbers at once.
SPLATS = 32

# (splat, tile) pairs per program in kernels with a lane per pair, and numbers that a program of Adam moves.
PAIRS = 512
NUMBERS_MOVED = 1024

# Numbers per record (`records.py`).
RECORD = 9


def tile_for(pixels: int) -> int:
    """The size of a tile, px, for so many pixels in all views."""
    return SMALL_TILE if pixels <= PIXELS_OF_SMALL else LARGE_TILE
