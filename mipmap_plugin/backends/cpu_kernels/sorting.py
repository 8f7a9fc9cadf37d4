"""The tiles' lists of splats: a counting sort by tile here, and a sort by depth when a tile is composited.

The splats are divided into runs. Each run counts its splats per tile; from all counts follows the offset at which each run writes its
splats of each tile. The runs are in order, so the lists do not depend on the number of runs.
"""

# numba redefines calls and operators.
# mypy: ignore-errors

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import types

from mipmap_plugin.backends.cpu_kernels import binning, inner, kernel, layout, threads
from mipmap_plugin.backends.cpu_kernels.blocks import put
from mipmap_plugin.backends.cpu_kernels.columns import outlines
from mipmap_plugin.backends.cpu_kernels.lanes import PART, WIDTH
from mipmap_plugin.backends.cpu_kernels.memory import beyond, pointer, scratch
from mipmap_plugin.backends.cpu_kernels.records import Lists
from mipmap_plugin.backends.cpu_kernels.threads import Team
from mipmap_plugin.process.pool import empty

# Of many splats several runs per thread, so that no thread waits long for the last one; but each run needs a counter for every tile.
RUNS_PER_THREAD = 8

# Bits of a depth per pass of the radix sort: most lists hold a few hundred splats, so more counters would dominate the time.
DIGIT_BITS = 8

# Lists of at most this length are sorted by insertion.
MAX_INSERTION = 32

# An entry of a list during sorting: the depth's bits above, the slot below. Positive floats sort like their bits.
SLOT_BITS = 32
_SLOT = (1 << SLOT_BITS) - 1
_DIGIT = (1 << DIGIT_BITS) - 1
DIGITS = 32 // DIGIT_BITS

new_block, new_spans = scratch(layout.OUTLINE_FIELDS * WIDTH, types.float32), scratch(2 * WIDTH, types.float64)
new_many, new_slots, new_counts = scratch(WIDTH, types.int32), scratch(WIDTH, types.int64), scratch(DIGITS << DIGIT_BITS, types.int64)


class Projected(NamedTuple):
    """A view's splats, of which lists are made."""

    table: np.ndarray  # [N, SPLAT_FIELDS]
    order: np.ndarray  # [N] depths, or ranks: by what splats are sorted
    counts: np.ndarray  # [N] int32, the number of tiles that each touches
    first_tiles: np.ndarray  # [N] int32, the first of these
    size: tuple[int, int]  # height, width

    @classmethod
    def of(cls, count: int, size: tuple[int, int]) -> Projected:
        """Room for so many splats in a picture of this size."""
        return cls(empty(count, layout.SPLAT_FIELDS), empty(count), empty(count, dtype=np.int32), empty(count, dtype=np.int32), size)

    @property
    def arrays(self) -> tuple[np.ndarray, ...]:
        """What `projection.project` fills."""
        return self[:4]


def tile_lists(views: Sequence[Projected], team: Team) -> list[Lists]:
    """Each tile's splats and their slots, of each view, not yet sorted by depth."""
    count = len(views[0].order)
    runs = 1 if team.threads == 1 else max(team.threads, min(RUNS_PER_THREAD * team.threads, count // threads.LEAST_ROWS))
    slots_before = np.zeros((len(views), runs + 1), np.int64)  # before each run, and of all
    team.share_all(count_slots, [(runs, (view.counts, befores[1:])) for view, befores in zip(views, slots_before, strict=True)])
    slots_before.cumsum(1, out=slots_before)
    written, jobs = [], []
    for view, befores in zip(views, slots_before, strict=True):
        pairs, (tiles_x, tiles_y) = int(befores[-1]), binning.tile_grid(view.size[1], view.size[0])
        firsts, splats, tiles = empty(count + 1, dtype=np.int64), empty(pairs, dtype=np.int32), empty(pairs, dtype=np.int32)
        written.append((firsts, splats, tiles, np.empty((runs, tiles_x * tiles_y), np.int64)))
        jobs.append((runs, (view.table, view.counts, view.first_tiles, *view.size, befores, *written[-1])))
    team.share_all(write_slots, jobs)
    lists, jobs = [], []
    for view, (firsts, splats, tiles, counts) in zip(views, written, strict=True):
        starts, pairs = offsets(counts), len(splats)
        lists.append(Lists(starts, empty(pairs, dtype=np.int32), empty(pairs, dtype=np.int64), empty(pairs, dtype=np.int64), firsts, splats))
        jobs.append((runs, (view.order.view(np.int32), firsts, tiles, counts, lists[-1].slots)))
    team.share_all(fill_entries, jobs)
    return lists


@inner
def run_bounds(count, run, runs):
    """The first splat of a run, and the first of the next."""
    return count * run // runs, count * (run + 1) // runs


@kernel
def count_slots(start, stop, counts, slots):
    """The number of slots of each of the runs start..stop."""
    for run in range(start, stop):
        first, last = run_bounds(len(counts), run, len(slots))
        total = np.int64(0)
        for i in range(first, last):
            total += counts[i]
        slots[run] = total


@kernel
def write_slots(start, stop, table, counts, first_tiles, height, width, befores, firsts, splats, tiles, tile_counts):
    """Number the slots of the runs start..stop, write the splat and the tile of each, and count the slots per run and tile."""
    many, next_slots, spans, block, tiles_of = new_many(), new_slots(), new_spans(), new_block(), pointer(tiles)
    for run in range(start, stop):
        tile_counts[run] = 0
        run_counts, slot, waiting = pointer(tile_counts[run]), befores[run], 0
        first, last = run_bounds(len(counts), run, len(tile_counts))
        for i in range(first, last):
            firsts[i], count = slot, counts[i]
            if count == 1:
                splats[slot], tiles[slot] = i, first_tiles[i]
                run_counts[first_tiles[i]] += 1
            elif count > 1:  # its tiles are found together with those of other such splats
                for at in range(slot, slot + count):
                    splats[at] = i
                many[waiting], next_slots[waiting] = i, slot
                waiting += 1
            slot += count
            if waiting == WIDTH or (waiting > 0 and i == last - 1):
                put_outlines(table, many, waiting, block)
                for part in range(0, waiting, PART):
                    drawn = (1 << min(waiting - part, PART)) - 1
                    binning.write_tiles(beyond(block, part), spans, drawn, beyond(next_slots, part), width, height, tiles_of, run_counts)
                waiting = 0
        if last == len(counts):
            firsts[last] = slot


@inner
def put_outlines(table, splats, count, block):
    """Fill a block with the outlines of some splats."""
    fields = outlines(table, splats, 0, count)
    for k in range(layout.OUTLINE_FIELDS):
        put(block, k, fields[k])


@kernel
def offsets(counts):
    """Replace the counts [runs, tiles] by the offsets at which each run writes each tile; return where each list starts, and the last one ends."""
    at, starts = 0, np.empty(counts.shape[1] + 1, np.int64)
    for tile in range(counts.shape[1]):
        starts[tile] = at
        for run in range(len(counts)):
            count = counts[run, tile]
            counts[run, tile] = at
            at += count
    starts[-1] = at
    return starts


@kernel
def fill_entries(start, stop, depths, firsts, tiles, run_offsets, entries):
    """Write the entries of the runs start..stop into the lists of their tiles."""
    for run in range(start, stop):
        offsets_of = pointer(run_offsets[run])
        first, last = run_bounds(len(depths), run, len(run_offsets))
        for i in range(first, last):
            for slot in range(firsts[i], firsts[i + 1]):
                tile = tiles[slot]
                at = offsets_of[tile]
                entries[at] = np.int64(depths[i]) << SLOT_BITS | slot
                offsets_of[tile] = at + 1


@kernel
def sort(start, stop, lists):
    """Sort the lists of the tiles start..stop front to back, and replace each entry by its slot and its splat.

    Of splats at equal depth, the one with the lower index is in front.
    """
    starts, members, entries, _, _, splats = lists
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
    for at in range(DIGITS << DIGIT_BITS):
        counts[at] = 0
    for n in range(first, first + length):
        depth = entries[n] >> SLOT_BITS
        for digit in range(DIGITS):
            counts[(digit << DIGIT_BITS) + ((depth >> (digit * DIGIT_BITS)) & _DIGIT)] += 1
    source, target, source_first, target_first = entries, spare, first, 0
    for digit in range(DIGITS):
        shift, mine = SLOT_BITS + digit * DIGIT_BITS, digit << DIGIT_BITS
        if counts[mine + ((source[source_first] >> shift) & _DIGIT)] == length:
            continue  # all entries have the same digit
        at = 0
        for value in range(mine, mine + (1 << DIGIT_BITS)):
            count = counts[value]
            counts[value] = at
            at += count
        for n in range(length):
            entry = source[source_first + n]
            value = mine + ((entry >> shift) & _DIGIT)
            target[target_first + counts[value]] = entry
            counts[value] += 1
        source, target, source_first, target_first = target, source, target_first, source_first
    for n in range(length):  # after an even number of passes, onto themselves
        entries[first + n] = source[source_first + n]
