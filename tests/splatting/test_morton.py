"""Morton codes: the bits of x, y and z take turns."""

import torch

from mipmap_plugin.morton import morton_codes

BITS = 21


def test_bits_of_all_axes_take_turns():
    cells = torch.randint(2**BITS, (200, 3), generator=torch.Generator().manual_seed(0))
    cells[0], cells[1] = 0, 2**BITS - 1
    expected = sum((cells[:, axis] >> bit & 1) << 3 * bit + axis for bit in range(BITS) for axis in range(3))
    assert torch.equal(morton_codes(cells), expected)
