"""LLVM's words for sixteen numbers side by side: what the functions on lanes are put together from.

Everything here runs while a kernel is compiled: it takes an LLVM builder and returns LLVM values.
"""

from llvmlite import ir
from numba.core import cgutils

from derender.render.raycast.lane_names import LANES

FLOATS = ir.VectorType(ir.FloatType(), LANES)
DOUBLES = ir.VectorType(ir.DoubleType(), LANES)
TABLE = ir.VectorType(ir.FloatType(), 8)
INTEGERS = ir.VectorType(ir.IntType(32), LANES)


def constant(value: float) -> ir.Constant:
    """Sixteen times a float32."""
    return ir.Constant(FLOATS, [ir.Constant(ir.FloatType(), value)] * LANES)


def integer(value: int) -> ir.Constant:
    """Sixteen times an int32."""
    return ir.Constant(INTEGERS, [ir.Constant(ir.IntType(32), value)] * LANES)


def splat(builder, scalar, vector_type=FLOATS):
    """Sixteen copies of a value."""
    single = builder.insert_element(ir.Constant(vector_type, ir.Undefined), scalar, ir.Constant(ir.IntType(32), 0))
    zeros = ir.Constant(ir.VectorType(ir.IntType(32), LANES), None)
    return builder.shuffle_vector(single, ir.Constant(vector_type, ir.Undefined), zeros)


def call(builder, name, *arguments):
    """Call an LLVM intrinsic on lanes."""
    function = cgutils.get_or_insert_function(
        builder.module, ir.FunctionType(arguments[0].type, [a.type for a in arguments]), f"llvm.{name}.v{LANES}f32"
    )
    return builder.call(function, arguments)


def multiply_add(builder, a, b, c):
    """a b + c, rounded once where the machine can."""
    return call(builder, "fmuladd", a, b, c)


def address(context, builder, array_type, array, row, column):
    """Pointer to element (row, column) of a C-contiguous 2-D float32 array."""
    struct = context.make_array(array_type)(context, builder, array)
    stride = builder.extract_value(struct.strides, 0)
    offset = builder.add(builder.mul(row, stride), builder.shl(column, ir.Constant(column.type, 2)))
    data = builder.bitcast(struct.data, ir.IntType(8).as_pointer())
    return builder.bitcast(builder.gep(data, [offset]), FLOATS.as_pointer())


def load(builder, pointer):
    """Sixteen neighbours, wherever they begin."""
    return builder.load(pointer, align=4)
