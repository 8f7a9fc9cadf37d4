"""Rows and columns of 16: of arrays whose rows are short, and of a splat's coefficients of degree 3, 16 bands of red, green and blue."""

# numba redefines calls and operators.
# mypy: ignore-errors

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from mipmap_plugin.backends.cpu_kernels import inner
from mipmap_plugin.backends.cpu_kernels.lanes import LANES, WIDTH, pattern
from mipmap_plugin.backends.cpu_kernels.layout import OUTLINE_FIELDS
from mipmap_plugin.backends.cpu_kernels.memory import load, rows_of, store

CHANNELS, BANDS = 3, WIDTH
THREE = types.UniTuple(LANES, CHANNELS)


def _shuffled(builder, first, second, places):
    """The numbers of two vectors at these places, of which the second's count from 16."""
    return builder.shuffle_vector(first, second, pattern(places))


@inner
def load_three(array, at):
    """The 48 numbers from array[at] on, as three vectors: 16 rows of an array [n, 3], or a splat's coefficients."""
    return load(array, at), load(array, at + WIDTH), load(array, at + 2 * WIDTH)


@inner
def load_four(array, at):
    """16 rows of an array [n, 4]."""
    return load(array, at), load(array, at + WIDTH), load(array, at + 2 * WIDTH), load(array, at + 3 * WIDTH)


@inner
def store_rows(array, at, vectors):
    """Store vectors one after the other."""
    for number in range(len(vectors)):
        store(array, at + number * WIDTH, vectors[number])


@intrinsic
def apart(_context, rows):
    """The columns of an array [16, n], whose rows lie in n vectors, one after the other."""

    def generate(context, builder, signature, values):
        vectors, columns = cgutils.unpack_tuple(builder, values[0], rows.count), []
        for column in range(rows.count):
            places = [rows.count * row + column for row in range(WIDTH)]
            found = _shuffled(builder, vectors[0], vectors[1], [min(place, 2 * WIDTH - 1) for place in places])
            for number in range(2, rows.count):
                taken = [row if place < number * WIDTH else WIDTH + min(place - number * WIDTH, WIDTH - 1) for row, place in enumerate(places)]
                found = _shuffled(builder, found, vectors[number], taken)
            columns.append(found)
        return cgutils.pack_array(builder, columns)

    return types.UniTuple(LANES, rows.count)(rows), generate


@intrinsic
def together(_context, columns):
    """The rows of an array [16, n], as n vectors, from its columns: the inverse of `apart`."""

    def generate(context, builder, signature, values):
        vectors, rows = cgutils.unpack_tuple(builder, values[0], columns.count), []
        for number in range(columns.count):
            places = [divmod(WIDTH * number + lane, columns.count) for lane in range(WIDTH)]  # the row and the column of each
            found = vectors[0]
            for column in range(1, columns.count):
                taken = [WIDTH + row if of == column else row if column == 1 else lane for lane, (row, of) in enumerate(places)]
                found = _shuffled(builder, found, vectors[column], taken)
            rows.append(found)
        return cgutils.pack_array(builder, rows)

    return types.UniTuple(LANES, columns.count)(columns), generate


@intrinsic
def thrice(_context, bands):
    """The number of each band, once for each of its coefficients."""

    def generate(context, builder, signature, values):
        parts = [[(WIDTH * part + lane) // CHANNELS for lane in range(WIDTH)] for part in range(CHANNELS)]
        return cgutils.pack_array(builder, [_shuffled(builder, values[0], values[0], places) for places in parts])

    return THREE(bands), generate


@intrinsic
def repeated(_context, red, green, blue):
    """A number of each channel, float32, once for each of its coefficients."""

    def generate(context, builder, signature, values):
        once = ir.Constant(LANES.vector, ir.Undefined)
        for channel, value in enumerate(values):
            once = builder.insert_element(once, value, ir.IntType(32)(channel))
        parts = [[(WIDTH * part + lane) % CHANNELS for lane in range(WIDTH)] for part in range(CHANNELS)]
        return cgutils.pack_array(builder, [_shuffled(builder, once, once, places) for places in parts])

    return THREE(types.float32, types.float32, types.float32), generate


@intrinsic
def transpose(_context, source, target):
    """Write the transpose of 16 x 16 float32 at one pointer to another: blocks that lie across from each other are swapped, ever larger ones."""

    def generate(context, builder, signature, values):
        read, written = (builder.bitcast(value, LANES.vector.as_pointer()) for value in values)
        rows = [builder.load(builder.gep(read, [ir.IntType(64)(row)]), align=4) for row in range(WIDTH)]
        for row, vector in enumerate(_transposed(builder, rows)):
            builder.store(vector, builder.gep(written, [ir.IntType(64)(row)]), align=4)
        return context.get_dummy_value()

    return types.void(source, target), generate


def _transposed(builder, rows):
    """The transposes of the blocks, as wide as there are rows, that lie side by side in vectors."""
    rows, size = list(rows), 1
    while size < len(rows):
        upper = [lane if not lane & size else WIDTH + lane - size for lane in range(WIDTH)]
        lower = [lane + size if not lane & size else WIDTH + lane for lane in range(WIDTH)]
        for row in (row for row in range(len(rows)) if not row & size):
            pair = rows[row], rows[row + size]
            rows[row], rows[row + size] = _shuffled(builder, *pair, upper), _shuffled(builder, *pair, lower)
        size *= 2
    return rows


@intrinsic
def outlines(_context, table, splats, begin, end):
    """The outlines (`layout`) of the splats[begin..end], of which the last stands for those that are missing to 16: a set of lanes each field."""

    def generate(context, builder, signature, values):
        data, fields = rows_of(context, builder, signature, values[0])
        half, i64 = ir.VectorType(ir.FloatType(), OUTLINE_FIELDS), ir.IntType(64)
        first, stop = (context.cast(builder, value, kind, types.intp) for value, kind in zip(values[2:], signature.args[2:], strict=True))
        last = builder.sub(stop, i64(1))

        def outline(number):
            at = builder.add(first, i64(number))
            splat = builder.load(builder.gep(values[1], [builder.select(builder.icmp_signed("<", at, last), at, last)]))
            address = builder.gep(data, [builder.mul(builder.sext(splat, i64), fields)])
            return builder.load(builder.bitcast(address, half.as_pointer()), align=4)

        beside = pattern(range(WIDTH))
        rows = [builder.shuffle_vector(outline(row), outline(row + OUTLINE_FIELDS), beside) for row in range(OUTLINE_FIELDS)]
        return cgutils.pack_array(builder, _transposed(builder, rows))

    return types.UniTuple(LANES, OUTLINE_FIELDS)(table, splats, begin, end), generate
