"""The tiles' lists of splats: a counting sort by tile here, and a sort by depth when a tile is composited.

The splats are divided into runs. Each run counts its splats per tile; from all counts follows the offset at which each run writes its
splats of each tile. The runs are in order, so the lists do not depend on the number of runs.
"""

# numba redefines calls and operators.
# mypy: ignore-errors

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import types

from mipmap_plugin.backends.cpu_kernels import binning, inner, kernel, layout, threads
from mipmap_plugin.backends.cpu_kernels.lanes import WIDTH
from mipmap_plugin.backends.cpu_kernels.memory import pointer, scratch
from mipmap_plugin.backends.cpu_kernels.records import Lists
from mipmap_plugin.backends.cpu_kernels.threads import Team
from mipmap_plugin.pool import empty

# Of many splats several runs per thread, so that no thread waits long for the last one; but each run needs a counter for every tile.
RUNS_PER_THREAD = 8

# Bits of a depth per pass of the radix sort: most lists hold a few hundred splats, so more counters would dominate the time.
DIGIT_BITS = 8

# Lists of at most this length are sorted by insertion.
MAX_INSERTION = 32

# An entry of a list during sorting: the depth's bits above, the slot below. Positive floats sort like their bits.
SLOT_BITS = 32
_SLOT = (1 << SLOT_BITS) - 1

new_block, new_spans = scratch(layout.OUTLINE_FIELDS * WIDTH, types.float32), scratch(2 * WIDTH, types.float64)
new_slots, new_counts = scratch(WIDTH, types.int64), scratch(1 << DIGIT_BITS, types.int64)


class Projected(NamedTuple):
    """A view's splats, of which lists are made."""

    table: np.ndarray  # [N, SPLAT_FIELDS]
    order: np.ndarray  # [N] depths, or ranks: by what splats are sorted
    slots: np.ndarray  # [N + 1] each splat's first slot
    size: tuple[int, int]  # height, width


def tile_lists(views: Sequence[Projected], team: Team) -> list[Lists]:
    """Each tile's splats and their slots, of each view, not yet sorted by depth."""
    count = len(views[0].order)
    runs = 1 if team.threads == 1 else max(team.threads, min(RUNS_PER_THREAD * team.threads, count // threads.LEAST_ROWS))
    written = []
    for _, _, slots, (height, width) in views:
        tiles_x, tiles_y = binning.tile_grid(width, height)
        pairs = int(slots[-1])
        written.append((empty(pairs, dtype=np.int32), empty(pairs, dtype=np.int32), np.empty((runs, tiles_x * tiles_y), np.int64)))
    team.share_all(write_slots, [(runs, (view.table, view.slots, *view.size, *places)) for view, places in zip(views, written, strict=True)])
    starts = [np.append(offsets(counts), len(tiles)) for tiles, _, counts in written]
    entries = [empty(len(tiles), dtype=np.int64) for tiles, _, _ in written]
    jobs = [
        (runs, (view.order.view(np.int32), view.slots, tiles, counts, into))
        for view, (tiles, _, counts), into in zip(views, written, entries, strict=True)
    ]
    team.share_all(fill_entries, jobs)
    splats_of = [splats for _, splats, _ in written]
    return [Lists(*lists) for lists in zip(starts, [empty(len(splats), dtype=np.int32) for splats in splats_of], entries, splats_of, strict=True)]


@inner
def run_bounds(slots, run, runs):
    """The first splat of a run, and the first of the next."""
    count = len(slots) - 1
    return count * run // runs, count * (run + 1) // runs


@kernel
def write_slots(start, stop, table, slots, height, width, tiles, splats, counts):
    """Write the tile and the splat of every slot in the runs start..stop, and count the slots per run and tile."""
    fields, block, spans, next_slots = pointer(table), new_block(), new_spans(), new_slots()
    for run in range(start, stop):
        counts[run] = 0
        run_counts = pointer(counts[run])
        first, last = run_bounds(slots, run, len(counts))
        for block_start in range(first, last, WIDTH):
            drawn = 0
            for lane in range(min(WIDTH, last - block_start)):
                i = block_start + lane
                next_slots[lane] = slots[i]
                if slots[i] < slots[i + 1]:
                    drawn |= 1 << lane
                    for k in range(layout.OUTLINE_FIELDS):
                        block[k * WIDTH + lane] = fields[i * layout.SPLAT_FIELDS + k]
                for slot in range(slots[i], slots[i + 1]):
                    splats[slot] = i
            if drawn != 0:
                binning.write_tiles(block, spans, drawn, next_slots, width, height, pointer(tiles), run_counts)


@kernel
def offsets(counts):
    """Replace the counts [runs, tiles] by the offsets at which each run writes each tile, and return where each tile's list starts."""
    at, starts = 0, np.empty(counts.shape[1], np.int64)
    for tile in range(len(starts)):
        starts[tile] = at
        for run in range(len(counts)):
            count = counts[run, tile]
            counts[run, tile] = at
            at += count
    return starts


@kernel
def fill_entries(start, stop, depths, slots, tiles, run_offsets, entries):
    """Write the entries of the runs start..stop into the lists of their tiles."""
    for run in range(start, stop):
        first, last = run_bounds(slots, run, len(run_offsets))
        for i in range(first, last):
            for slot in range(slots[i], slots[i + 1]):
                at = run_offsets[run, tiles[slot]]
                entries[at] = np.int64(depths[i]) << SLOT_BITS | slot
                run_offsets[run, tiles[slot]] = at + 1


@kernel
def sort(start, stop, lists):
    """Sort the lists of the tiles start..stop front to back, and replace each entry by its slot and its splat.

    Of splats at equal depth, the one with the lower index is in front.
    """
    starts, members, entries, splats = lists
    longest = 0
    for tile in range(start, stop):
        longest = max(longest, starts[tile + 1] - starts[tile])
    spare, counts, lists_of = np.empty(longest, np.int64), new_counts(), pointer(entries)
    for tile in range(start, stop):
        first, last = starts[tile], starts[tile + 1]
        if last - first > MAX_INSERTION:
            sort_long(lists_of, first, last - first, pointer(spare), counts)
        else:
            sort_short(lists_of, first, last)
        for at in range(first, last):
            slot = entries[at] & _SLOT
            entries[at], members[at] = slot, splats[slot]


@inner
def sort_short(entries, first, last):
    """Insertion sort."""
    for n in range(first + 1, last):
        entry, at = entries[n], n
        while at > first and entries[at - 1] > entry:
            entries[at] = entries[at - 1]
            at -= 1
        entries[at] = entry


@inner
def sort_long(entries, first, length, spare, counts):
    """Radix sort by depth of the `length` entries from `first` on; stable."""
    source, target, source_first, target_first = entries, spare, first, 0
    for shift in range(SLOT_BITS, 2 * SLOT_BITS, DIGIT_BITS):
        for digit in range(1 << DIGIT_BITS):
            counts[digit] = 0
        for n in range(length):
            counts[(source[source_first + n] >> shift) & ((1 << DIGIT_BITS) - 1)] += 1
        if counts[(source[source_first] >> shift) & ((1 << DIGIT_BITS) - 1)] == length:
            continue  # all entries have the same digit
        at = 0
        for digit in range(1 << DIGIT_BITS):
            count = counts[digit]
            counts[digit] = at
            at += count
        for n in range(length):
            entry = source[source_first + n]
            digit = (entry >> shift) & ((1 << DIGIT_BITS) - 1)
            target[target_first + counts[digit]] = entry
            counts[digit] += 1
        source, target, source_first, target_first = target, source, target_first, source_first
    for n in range(length):  # after an even number of passes, onto themselves
        entries[first + n] = source[source_first + n]
