"""Memory in kernels: pointers, scratch space on the stack, and loads and stores of lanes."""

# numba redefines calls and operators.
# mypy: ignore-errors

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from mipmap_plugin.backends.cpu_kernels.lanes import PART, WIDTH, Lanes, integers

# Bytes of a cache line.
CACHE_LINE = 64


@intrinsic
def pointer(_context, array):
    """A pointer to a contiguous array. Unlike an array it counts no references: the caller keeps the array alive."""

    def generate(context, builder, signature, values):
        return context.make_array(signature.args[0])(context, builder, values[0]).data

    return types.CPointer(array.dtype)(array), generate


@intrinsic
def row_of(_context, array, row):
    """A pointer to array[row] of a contiguous array [n, m]; as `pointer`."""

    def generate(context, builder, signature, values):
        data, fields = rows_of(context, builder, signature, values[0])
        row = context.cast(builder, values[1], signature.args[1], types.intp)
        return builder.gep(data, [builder.mul(row, fields)])

    return types.CPointer(array.dtype)(array, row), generate


def rows_of(context, builder, signature, array):
    """A pointer to an array [n, m], and m."""
    record = context.make_array(signature.args[0])(context, builder, array)
    return record.data, builder.extract_value(record.shape, 1)


def scratch(count, number):
    """A function that returns a pointer to `count` zeros of a numba type, on the stack of the kernel that calls it."""

    @intrinsic
    def zeros(_context):
        def generate(context, builder, signature, values):
            kind = ir.ArrayType(context.get_data_type(number), count)
            with builder.goto_entry_block():  # `cgutils.alloca_once` would store an array of zeros, which LLVM takes 1 s to take apart
                space = builder.alloca(kind)
            space.align = CACHE_LINE
            cgutils.memset(builder, space, ir.IntType(64)(context.get_abi_sizeof(kind)), 0)
            return builder.bitcast(space, space.type.pointee.element.as_pointer())

        return types.CPointer(number)(), generate

    return zeros


def _address(context, builder, kind, array, index, vector):
    """Where in an array, or from a pointer on, such a vector lies."""
    data = array if isinstance(kind, types.CPointer) else context.make_array(kind)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), vector.as_pointer())


def _loader(widths):
    """An intrinsic that loads the numbers from array[index] on of a contiguous array [n], or from a pointer: so many float32 or float64."""

    def typed(_context, array, index):
        lanes = Lanes(array.dtype, widths[array.dtype])

        def generate(context, builder, signature, values):
            index = context.cast(builder, values[1], signature.args[1], types.intp)
            return builder.load(_address(context, builder, array, values[0], index, lanes.vector), align=4)

        return lanes(array, index), generate

    return intrinsic(typed)


# Bounds are not checked. `load_part`: of float32, for the geometry of a part; `load_whole`: of float64, the numbers of all parts.
load = _loader({types.float32: WIDTH, types.float64: PART})
load_part, load_whole = _loader({types.float32: PART}), _loader({types.float64: WIDTH})


@intrinsic
def beyond(_context, array, count):
    """A pointer `count` numbers beyond another."""

    def generate(context, builder, signature, values):
        return builder.gep(values[0], [context.cast(builder, values[1], signature.args[1], types.intp)])

    return array(array, count), generate


@intrinsic
def store(_context, array, index, lanes):
    """As many numbers as there are lanes, from array[index] on, = lanes."""

    def generate(context, builder, signature, values):
        index = context.cast(builder, values[1], signature.args[1], types.intp)
        builder.store(values[2], _address(context, builder, array, values[0], index, lanes.vector), align=4)
        return context.get_dummy_value()

    return types.void(array, index, lanes), generate


@intrinsic
def store_integers(_context, array, index, lanes):
    """As `store`, for a pointer to int32; what is no integer of 32 bits becomes any."""

    def generate(context, builder, signature, values):
        index = context.cast(builder, values[1], signature.args[1], types.intp)
        ints = integers(lanes.width)
        address = builder.bitcast(builder.gep(values[0], [index]), ints.as_pointer())
        builder.store(builder.fptosi(values[2], ints), address, align=4)
        return context.get_dummy_value()

    return types.void(array, index, lanes), generate


@intrinsic
def store_bit_ranges(_context, array, begins, ends):
    """Store 16 integers, for a pointer to int64: word k of each, of 16 bits, has the bits from `begins`[k] up to, but without, `ends`[k], 0..16.

    Both are tuples of four lanes.
    """

    def generate(context, builder, signature, values):
        begins, ends = (cgutils.unpack_tuple(builder, value, 4) for value in values[1:])
        short, long = integers(WIDTH), integers(WIDTH, 64)
        one, word = (ir.Constant(short, [number] * WIDTH) for number in (1, 16))
        first, second, third, fourth = (
            builder.sub(*(builder.shl(one, builder.fptosi(edge, short)) for edge in edges)) for edges in zip(ends, begins, strict=True)
        )
        low, high = (builder.or_(even, builder.shl(odd, word)) for even, odd in ((first, second), (third, fourth)))
        words = builder.or_(builder.zext(low, long), builder.shl(builder.zext(high, long), ir.Constant(long, [32] * WIDTH)))
        builder.store(words, builder.bitcast(values[0], long.as_pointer()), align=8)
        return context.get_dummy_value()

    return types.void(array, begins, ends), generate


@intrinsic
def prefetch(_context, array, row):
    """Prefetch the cache line at array[row] of a contiguous array [n, m]."""

    def generate(context, builder, signature, values):
        data, fields = rows_of(context, builder, signature, values[0])
        row = context.cast(builder, values[1], signature.args[1], types.intp)
        address = builder.bitcast(builder.gep(data, [builder.mul(row, fields)]), cgutils.voidptr_t)
        i32 = ir.IntType(32)
        signature = ir.FunctionType(ir.VoidType(), [cgutils.voidptr_t, i32, i32, i32])
        function = cgutils.get_or_insert_function(builder.module, signature, "llvm.prefetch.p0")
        builder.call(function, [address, i32(0), i32(3), i32(1)])  # for reading, into every cache level, as data
        return context.get_dummy_value()

    return types.void(array, row), generate
