"""The compiled kernels of the CPU backend; only this package imports numba.

Memory layout. All arrays are contiguous; a pair is a splat and a tile that it touches.

    splat table [N, 16] float32 (`layout`): one row, one cache line, per splat.

        splat 0   | X | Y | SHEAR | FALL_Y | PEAK | PER_FALL_X | ... | RED | GREEN | BLUE | GAIN | OFFSET | GATE | unused |
        splat 1   | ...

    block (`blocks`), on the stack: the fields of 16 splats, so that one field is one set of lanes (`lanes`). Geometry is in
    float64, of which a register holds fewer: it is computed part by part of the 16.

        | X of 16 splats | Y of 16 splats | SHEAR of 16 splats | ...

    gradient table [pairs, 9] float32 (`layout`): one row per pair, splat after splat; the row is the pair's slot. The backward pass of
    compositing writes the rows tile by tile; `projection_back` sums the rows of each splat.

                        firsts[0]           firsts[1]    firsts[2]                       firsts[N] = pairs
                        v                   v            v                               v
        rows            | splat 0: 3 tiles  | 2 tiles    | ...                           |

    lists (`records.Lists`): the pairs by tile, and in each tile front to back. `members` has their splats, `slots` their slots, and
    `patches` integers whose bits are the patches that they touch.

                        starts[0]                        starts[1]                       starts[tiles] = pairs
                        v                                v                               v
        members, ...    | tile 0, front to back          | tile 1 ...                    |

    tile (`planes`), on the stack: 16 x 4 patches of 4 x 4 px. Each quantity is a plane with the 16 px of one patch after the other's, so
    that a patch is one set of lanes.

        red, green, blue, TRANSMITTANCE,      | patch 0: 16 px | patch 1 ...                  | patch 15 |
        STOPS, BEHIND_DOT_GRAD: each          | patch 16       | ...                          |          |
                                              | ...            |                              | patch 63 |

numba counts references to arrays, and to records that hold arrays; each count is an atomic operation, and a few per splat cost more
than all of its geometry. So a kernel takes arrays out of their records once, and passes pointers, numbers and tuples of them to the
functions that it calls per splat (`memory`). Those are always inlined, because numba passes lanes through memory otherwise.
"""

from contextlib import suppress
from pathlib import Path

from mipmap_plugin.backends.cpu_kernels.compiling import IS_KNOWN, inner, kernel

__all__ = ["inner", "kernel"]


def _forget_stale() -> None:
    """Delete cached machine code older than any source here: numba itself checks only a kernel's own file, not those of the functions it calls."""
    folder = Path(__file__).parent
    newest = max(source.stat().st_mtime for source in folder.glob("*.py"))
    for compiled in folder.glob("__pycache__/*.nb[ci]"):
        with suppress(OSError):  # another process may delete it first; in a read-only folder numba caches nothing
            if compiled.stat().st_mtime < newest:
                compiled.unlink()


if not IS_KNOWN:  # otherwise `compiling` sees to it
    _forget_stale()
