"""Each tile's list of splats, front to back: sorted by tile while they are cut into runs, then by depth as tiles are composited.

Each run of splats counts its tiles; the counts of all runs tell where each puts its first splat of each tile; then each writes its
own. As the runs are in order, the outcome is the same for any number of them.
"""

# numba gives calls and operators a meaning of its own.
# mypy: ignore-errors

import numpy as np
from numba import types

from mipmap_plugin.backends.cpu_kernels import binning, inner, kernel
from mipmap_plugin.backends.cpu_kernels import columns as col
from mipmap_plugin.backends.cpu_kernels.lanes import WIDTH
from mipmap_plugin.backends.cpu_kernels.memory import pointer, scratch
from mipmap_plugin.backends.cpu_kernels.records import Lists

# More than one for each thread, so that none waits long for the last; but all count every tile.
RUNS_PER_THREAD = 8

# Bits of a depth sorted at a time: most lists hold some hundred splats, and more counters than that would take longest.
DIGIT = 8

# Lists of up to so many are sorted by insertion.
SHORT = 32

# An entry of a list while it is sorted: the depth's bits above, the slot below. Positive floats sort as their bits do.
SLOT_BITS = 32
_SLOT = (1 << SLOT_BITS) - 1

new_block, new_spans = scratch(col.OUTLINE * WIDTH, types.float32), scratch(2 * WIDTH, types.float64)
new_places = scratch(WIDTH, types.int64)


def tile_lists(table, depths, slots, width, height, team):
    """Each tile's splats and their slots, not yet sorted by depth."""
    columns, rows = binning.tile_grid(width, height)
    pairs = int(slots[-1])
    runs = 1 if team.threads == 1 else RUNS_PER_THREAD * team.threads
    tiles, splats, counts = np.empty(pairs, np.int32), np.empty(pairs, np.int32), np.empty((runs, columns * rows), np.int64)
    team.share(cover, runs, table, slots, width, height, tiles, splats, counts)
    starts = np.append(begin(counts), pairs)
    entries = np.empty(pairs, np.int64)
    team.share(fill, runs, depths.view(np.int32), slots, tiles, counts, entries)
    return Lists(starts, np.empty(pairs, np.int32), entries, splats)


@inner
def cut(slots, run, runs):
    """Where a run of splats begins and ends."""
    count = len(slots) - 1
    return count * run // runs, count * (run + 1) // runs


@kernel
def cover(start, stop, table, slots, width, height, tiles, splats, counts):
    """Write the tile and the splat of every slot in the runs start..stop, and count how often each tile occurs in each run."""
    rows, block, spans, at = pointer(table), new_block(), new_spans(), new_places()
    for run in range(start, stop):
        counts[run] = 0
        tally = pointer(counts[run])
        first, last = cut(slots, run, len(counts))
        for begin in range(first, last, WIDTH):
            drawn = 0
            for lane in range(min(WIDTH, last - begin)):
                i = begin + lane
                at[lane] = slots[i]
                if slots[i] < slots[i + 1]:
                    drawn |= 1 << lane
                    for k in range(col.OUTLINE):
                        block[k * WIDTH + lane] = rows[i * col.COLUMNS + k]
                for slot in range(slots[i], slots[i + 1]):
                    splats[slot] = i
            if drawn != 0:
                binning.cover(block, spans, drawn, at, width, height, pointer(tiles), tally)


@kernel
def begin(counts):
    """Turn the counts into the places where each run begins to write each tile; where the tiles begin."""
    at, starts = 0, np.empty(counts.shape[1], np.int64)
    for tile in range(len(starts)):
        starts[tile] = at
        for run in range(len(counts)):
            count = counts[run, tile]
            counts[run, tile] = at
            at += count
    return starts


@kernel
def fill(start, stop, depths, slots, tiles, begins, entries):
    """Write the entries of the runs start..stop into the lists of their tiles."""
    for run in range(start, stop):
        first, last = cut(slots, run, len(begins))
        for i in range(first, last):
            for slot in range(slots[i], slots[i + 1]):
                at = begins[run, tiles[slot]]
                entries[at] = np.int64(depths[i]) << SLOT_BITS | slot
                begins[run, tiles[slot]] = at + 1


@kernel
def sort(start, stop, lists):
    """Sort the lists of the tiles start..stop front to back, and leave of each entry its slot and its splat.

    Of equal depths, the splat with the lower index is in front.
    """
    starts, members, entries, splats = lists
    longest = 0
    for tile in range(start, stop):
        longest = max(longest, starts[tile + 1] - starts[tile])
    spare, counts = np.empty(longest, np.int64), np.empty(1 << DIGIT, np.int64)
    for tile in range(start, stop):
        first, last = starts[tile], starts[tile + 1]
        if last - first > SHORT:
            sort_long(entries[first:last], spare[: last - first], counts)
        else:
            sort_short(entries, first, last)
        for at in range(first, last):
            slot = entries[at] & _SLOT
            entries[at], members[at] = slot, splats[slot]


@inner
def sort_short(entries, first, last):
    for n in range(first + 1, last):
        entry, at = entries[n], n
        while at > first and entries[at - 1] > entry:
            entries[at] = entries[at - 1]
            at -= 1
        entries[at] = entry


@inner
def sort_long(entries, spare, counts):
    """A radix sort by depth, which leaves equal depths in order."""
    here, there = entries, spare
    for shift in range(SLOT_BITS, 2 * SLOT_BITS, DIGIT):
        counts[:] = 0
        for entry in here:
            counts[(entry >> shift) & ((1 << DIGIT) - 1)] += 1
        if counts[(here[0] >> shift) & ((1 << DIGIT) - 1)] == len(here):
            continue  # all alike
        at = 0
        for digit in range(1 << DIGIT):
            count = counts[digit]
            counts[digit] = at
            at += count
        for entry in here:
            digit = (entry >> shift) & ((1 << DIGIT) - 1)
            there[counts[digit]] = entry
            counts[digit] += 1
        here, there = there, here
    entries[:] = here
