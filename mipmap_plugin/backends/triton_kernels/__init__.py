"""The Triton backend's kernels: projection, binning and compositing, each with its backward pass.

Memory layout. All arrays are contiguous; `d_x` is the gradient of the loss with respect to `x`.

    splat n:      means [N, 3]  quats [N, 4]  scales [N, 3] (or covariances [N, 3, 3])  opacities [N]  sh [N, BANDS, 3]
                       |
                       v  project_kernel, a lane per splat
    splat n:      records [N, 9]: | x | y | along | shear | across | log2 opacity | red | green | blue |     depths [N]
                  boxes [N, 4]:   | first tile_x | first tile_y | width in tiles | number of tiles |
                       |
                       v  sort by depth, emit_kernel, stable sort by tile: one (splat, tile) pair per tile of a box
    pair p:       splat_ids [P]:  | tile 0, front to back | tile 1, front to back | ... | pairs in no tile |
                                  ^                       ^                             ^
                  tile_offsets:   0                       1                             tiles      [tiles + 1]
                       |
                       v  composite_kernel, a program per tile
    pixel (y, x): image [H, W, 3]  transmittances [H, W]

composite_back_kernel adds the gradients of a tile's pixels to d_records [N, 9]. With deterministic sums it writes one row per pair
instead; the pairs of a splat lie side by side there, and gather_kernel sums them in order. project_back_kernel does the rest.

Compute capability 7.5 suffices: plain loads, stores and float32 atomics. The constants below set how work is divided; none of them
changes an image, and none has been tuned on a GPU.
"""

# px. A program renders one tile. Other rasterizers use 16 x 16 as well: 8 x 8 would halve the wasted pixels and double the pairs to sort.
TILE = 16

# Splats between two checks whether a pixel of the tile is still open. Their loads overlap; larger batches need more registers.
FORWARD_BATCH = 4
BACKWARD_BATCH = 2

# Warps per tile. One warp spends 23 instructions on a (splat, pixel) pair, four spend 35 (counted in the code for compute capability
# 8.0); but with few tiles, one warp per tile leaves most of a GPU idle, and 17 of them fill a multiprocessor's registers.
MANY_TILES = 4096
WARPS_OF_MANY, WARPS_OF_FEW = 1, 4

# Splats per program in kernels with a lane per splat: small blocks, for a thread holds over a hundred numbers at once.
SPLATS = 128

# (splat, tile) pairs per program in kernels with a lane per pair.
PAIRS = 512

# Numbers per record (`records.py`).
RECORD = 9
