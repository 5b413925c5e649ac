"""The blur of sixteen columns side by side (`lanes`), its taps unrolled: along a row, and down a window of rows."""

from llvmlite import ir
from numba.core import types
from numba.core.datamodel import models
from numba.extending import intrinsic, register_model

from derender.render.raycast import lane_code as code
from derender.render.raycast.lanes import float_lanes


class _WindowType(types.Type):
    """The numba type of 2 radius + 1 lanes: what a blur sees of the rows around one row."""

    def __init__(self, radius: int) -> None:
        self.radius = radius
        super().__init__(f"window{radius}")


@register_model(_WindowType)
class _WindowModel(models.PrimitiveModel):
    def __init__(self, manager, numba_type):
        super().__init__(manager, numba_type, ir.ArrayType(code.FLOATS, 2 * numba_type.radius + 1))


@intrinsic(prefer_literal=True)
def new_window(typing, value, radius):
    """A window all of whose rows are `value`; radius a literal."""
    if not isinstance(radius, types.IntegerLiteral):
        return None
    window = _WindowType(radius.literal_value)

    def generate(context, builder, signature, arguments):
        result = ir.Constant(ir.ArrayType(code.FLOATS, 2 * window.radius + 1), ir.Undefined)
        for k in range(2 * window.radius + 1):
            result = builder.insert_value(result, arguments[0], k)
        return result

    return window(float_lanes, radius), generate


@intrinsic
def push(typing, window, value):
    """The window one row further down: the first row falls out, `value` comes in last. It stays in registers."""
    if not isinstance(window, _WindowType):
        return None

    def generate(context, builder, signature, arguments):
        old, result = arguments[0], ir.Constant(arguments[0].type, ir.Undefined)
        for k in range(2 * window.radius):
            result = builder.insert_value(result, builder.extract_value(old, k + 1), k)
        return builder.insert_value(result, arguments[1], 2 * window.radius)

    return window(window, float_lanes), generate


@intrinsic
def blur_window(typing, window, taps):
    """sum_k taps[|k|] window[radius + k]: the blur down the column at the window's middle row."""
    if not isinstance(window, _WindowType):
        return None
    radius = window.radius

    def generate(context, builder, signature, arguments):
        weights = _taps(context, builder, signature.args[1], arguments[1], radius + 1)
        rows = [builder.extract_value(arguments[0], k) for k in range(2 * radius + 1)]
        pairs = [(rows[radius - k], rows[radius + k]) for k in range(1, radius + 1)]
        return _symmetric_sum(builder, weights, rows[radius], pairs)

    return float_lanes(window, taps), generate


@intrinsic(prefer_literal=True)
def blur_along_row(typing, array, row, column, taps, radius):
    """sum_k taps[|k|] array[row, column + k] over |k| <= radius for sixteen columns; radius a literal, unrolled."""
    if not isinstance(radius, types.IntegerLiteral):
        return None
    count = radius.literal_value

    def generate(context, builder, signature, arguments):
        array, row, column, tap_array, _ = arguments
        weights = _taps(context, builder, signature.args[3], tap_array, count + 1)

        def at(offset):
            shifted = builder.add(column, ir.Constant(column.type, offset))
            return code.load(builder, code.address(context, builder, signature.args[0], array, row, shifted))

        pairs = [(at(-k), at(k)) for k in range(1, count + 1)]
        return _symmetric_sum(builder, weights, at(0), pairs)

    return float_lanes(array, types.int64, types.int64, taps, radius), generate


def _symmetric_sum(builder, taps, centre, pairs):
    """taps[0] centre + sum_k taps[k] (left_k + right_k), in one fixed order."""
    value = builder.fmul(taps[0], centre)
    for tap, (left, right) in zip(taps[1:], pairs, strict=True):
        value = code.multiply_add(builder, tap, builder.fadd(left, right), value)
    return value


def _taps(context, builder, array_type, array, count):
    struct = context.make_array(array_type)(context, builder, array)
    index = ir.IntType(64)
    return [code.splat(builder, builder.load(builder.gep(struct.data, [ir.Constant(index, k)]))) for k in range(count)]
