"""Memory of kernels: pointers, room on the stack, and how lanes come from both and from arrays."""

# numba gives calls and operators a meaning of its own.
# mypy: ignore-errors

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from mipmap_plugin.backends.cpu_kernels.lanes import DOUBLES, LANES, VECTOR32, VECTOR64

# Bytes of a cache line.
LINE = 64


@intrinsic
def pointer(_context, array):
    """Where a contiguous array begins. Unlike an array it counts no references: the caller keeps the array while it is in use."""

    def generate(context, builder, signature, values):
        return context.make_array(signature.args[0])(context, builder, values[0]).data

    return types.CPointer(array.dtype)(array), generate


@intrinsic
def row_of(_context, array, row):
    """Where array[row] of a contiguous array [n, m] begins; as `pointer`."""

    def generate(context, builder, signature, values):
        data, columns = _rows(context, builder, signature, values[0])
        row = context.cast(builder, values[1], signature.args[1], types.intp)
        return builder.gep(data, [builder.mul(row, columns)])

    return types.CPointer(array.dtype)(array, row), generate


def _rows(context, builder, signature, array):
    """Where an array [n, m] begins, and m."""
    record = context.make_array(signature.args[0])(context, builder, array)
    return record.data, builder.extract_value(record.shape, 1)


def scratch(count, number):
    """What gives a pointer to `count` zeros of a numba type, on the stack of the kernel that calls it."""

    @intrinsic
    def zeros(_context):
        def generate(context, builder, signature, values):
            room = cgutils.alloca_once(builder, ir.ArrayType(context.get_data_type(number), count))
            room.align = LINE
            builder.store(ir.Constant(room.type.pointee, None), room)
            return builder.bitcast(room, room.type.pointee.element.as_pointer())

        return types.CPointer(number)(), generate

    return zeros


def _place(context, builder, kind, array, index):
    data = array if isinstance(kind, types.CPointer) else context.make_array(kind)(context, builder, array).data
    vector = VECTOR64 if kind.dtype == types.float64 else VECTOR32
    return builder.bitcast(builder.gep(data, [index]), vector.as_pointer())


@intrinsic
def load(_context, array, index):
    """array[index : index + 16] of a contiguous array [n] of float32 or float64, or of a pointer. The caller keeps within bounds."""

    def generate(context, builder, signature, values):
        index = context.cast(builder, values[1], signature.args[1], types.intp)
        return builder.load(_place(context, builder, signature.args[0], values[0], index), align=4)

    return (DOUBLES if array.dtype == types.float64 else LANES)(array, index), generate


@intrinsic
def store(_context, array, index, lanes):
    """array[index : index + 16] = lanes."""

    def generate(context, builder, signature, values):
        index = context.cast(builder, values[1], signature.args[1], types.intp)
        builder.store(values[2], _place(context, builder, signature.args[0], values[0], index), align=4)
        return context.get_dummy_value()

    return types.void(array, index, lanes), generate


@intrinsic
def prefetch(_context, array, row):
    """Ask for array[row] of a contiguous array [n, m], so that it is at hand a little later."""

    def generate(context, builder, signature, values):
        data, columns = _rows(context, builder, signature, values[0])
        row = context.cast(builder, values[1], signature.args[1], types.intp)
        place = builder.bitcast(builder.gep(data, [builder.mul(row, columns)]), cgutils.voidptr_t)
        number = ir.IntType(32)
        signature = ir.FunctionType(ir.VoidType(), [cgutils.voidptr_t, number, number, number])
        function = cgutils.get_or_insert_function(builder.module, signature, "llvm.prefetch.p0")
        builder.call(function, [place, number(0), number(3), number(1)])  # to read, into every cache, as data
        return context.get_dummy_value()

    return types.void(array, row), generate
