"""Sixteen float32 side by side as one value in compiled code: what numba's own vectoriser cannot promise.

Inside an njit function `load(array, row, column)` gives sixteen neighbours, and add, multiply_add, maximum, ... work
on all of them at once; LLVM maps them to AVX-512, AVX2, SSE or NEON. There is no scalar remainder loop and no
reassociation, so a pixel's value never depends on where in a row, or in which call, it was computed: the incremental
and the full evaluation agree to the last bit. Arrays are C-contiguous float32; rows must be padded so that sixteen
may be read. The blur is of sixteen columns side by side, its taps unrolled: along a row, and down a window of rows.
"""

from collections.abc import Callable
from functools import wraps
from typing import Any

from llvmlite import binding, ir
from numba.core import cgutils, config, types
from numba.core.datamodel import models
from numba.extending import intrinsic, register_model

from derender.render.raycast.lane_names import LANES

FLOATS = ir.VectorType(ir.FloatType(), LANES)
DOUBLES = ir.VectorType(ir.DoubleType(), LANES)
INTEGERS = ir.VectorType(ir.IntType(32), LANES)
WIDE_APART = 12.0  # logarithms of two densities of which the lesser is 6e-6 of their sum: ten roundings of a score


class _LanesType(types.Type):
    """The numba type of sixteen float32 or float64."""


float_lanes = _LanesType("float32x16")
double_lanes = _LanesType("float64x16")
_MODELS = {float_lanes.name: FLOATS, double_lanes.name: DOUBLES}


def machine_has(feature: str) -> bool:
    """Whether the machine compiled for has an extension of its instructions, such as avx2."""
    features = vars(config)["CPU_FEATURES"]
    if features is not None:
        return f"+{feature}" in features
    return bool(binding.get_host_cpu_features().get(feature))


def _constant(value: float) -> ir.Constant:
    """Sixteen times a float32."""
    return ir.Constant(FLOATS, [ir.Constant(ir.FloatType(), value)] * LANES)


def _integer(value: int) -> ir.Constant:
    """Sixteen times an int32."""
    return ir.Constant(INTEGERS, [ir.Constant(ir.IntType(32), value)] * LANES)


def _splat(builder, scalar):
    """Sixteen copies of a value."""
    single = builder.insert_element(ir.Constant(FLOATS, ir.Undefined), scalar, ir.Constant(ir.IntType(32), 0))
    zeros = ir.Constant(ir.VectorType(ir.IntType(32), LANES), None)
    return builder.shuffle_vector(single, ir.Constant(FLOATS, ir.Undefined), zeros)


def _call(builder, name, *arguments):
    """Call an LLVM intrinsic on lanes."""
    function = cgutils.get_or_insert_function(
        builder.module, ir.FunctionType(arguments[0].type, [a.type for a in arguments]), f"llvm.{name}.v{LANES}f32"
    )
    return builder.call(function, arguments)


def _multiply_add(builder, a, b, c):
    """a b + c, rounded once where the machine can."""
    return _call(builder, "fmuladd", a, b, c)


def _address(context, builder, array_type, array, row, column):
    """Pointer to element (row, column) of a C-contiguous 2-D array of float32 or float64."""
    struct = context.make_array(array_type)(context, builder, array)
    stride = builder.extract_value(struct.strides, 0)
    bits, kind = (2, FLOATS) if array_type.dtype == types.float32 else (3, DOUBLES)
    offset = builder.add(builder.mul(row, stride), builder.shl(column, ir.Constant(column.type, bits)))
    data = builder.bitcast(struct.data, ir.IntType(8).as_pointer())
    return builder.bitcast(builder.gep(data, [offset]), kind.as_pointer())


def _load(builder, pointer):
    """Sixteen neighbours, wherever they begin."""
    return builder.load(pointer, align=4)


@register_model(_LanesType)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager: Any, numba_type: Any) -> None:
        super().__init__(manager, numba_type, _MODELS[numba_type.name])


def _check(array: Any, dtype: Any = types.float32) -> Any:
    return isinstance(array, types.Array) and array.ndim == 2 and array.dtype == dtype and array.layout == "C"


def _emitted(*kinds: Any, gives: Any = float_lanes) -> Callable:
    """Make an intrinsic of values of these types from what emits it: emit(builder, *values)."""

    def intrinsic_of(emit):
        @wraps(emit)
        def typed(typing, *_):
            return gives(*kinds), lambda context, builder, signature, values: emit(builder, *values)

        return intrinsic(typed)

    return intrinsic_of


@intrinsic
def load(typing: Any, array: Any, row: Any, column: Any) -> Any:
    """Sixteen elements of a 2-D float32 array from (row, column) on. No bounds are checked."""
    if not _check(array):
        return None

    def generate(context, builder, signature, arguments):
        return _load(builder, _address(context, builder, signature.args[0], *arguments))

    return float_lanes(array, types.int64, types.int64), generate


@intrinsic
def load_rounded(typing: Any, array: Any, row: Any, column: Any) -> Any:
    """Sixteen elements of a 2-D float64 array from (row, column) on, rounded to float32. No bounds are checked."""
    if not _check(array, types.float64):
        return None

    def generate(context, builder, signature, arguments):
        pointer = _address(context, builder, signature.args[0], *arguments)
        return builder.fptrunc(builder.load(pointer, align=8), FLOATS)

    return float_lanes(array, types.int64, types.int64), generate


@intrinsic
def store(typing: Any, array: Any, row: Any, column: Any, value: Any) -> Any:
    """Write sixteen elements of a 2-D float32 array from (row, column) on. No bounds are checked."""
    if not _check(array):
        return None

    def generate(context, builder, signature, arguments):
        builder.store(arguments[3], _address(context, builder, signature.args[0], *arguments[:3]), align=4)
        return context.get_dummy_value()

    return types.void(array, types.int64, types.int64, float_lanes), generate


@_emitted(types.float32)
def splat(builder, value):
    """Sixteen copies of a number."""
    return _splat(builder, value)


@_emitted(types.int64)
def steps_from(builder, start):
    """start, start + 1, ..., start + 15 (exact up to 2^24)."""
    ramp = ir.Constant(FLOATS, [ir.Constant(ir.FloatType(), float(k)) for k in range(LANES)])
    return builder.fadd(_splat(builder, builder.sitofp(start, ir.FloatType())), ramp)


add = _emitted(float_lanes, float_lanes)(lambda builder, a, b: builder.fadd(a, b))
subtract = _emitted(float_lanes, float_lanes)(lambda builder, a, b: builder.fsub(a, b))
multiply = _emitted(float_lanes, float_lanes)(lambda builder, a, b: builder.fmul(a, b))
divide = _emitted(float_lanes, float_lanes)(lambda builder, a, b: builder.fdiv(a, b))


@_emitted(float_lanes, float_lanes)
def maximum(builder, a, b):
    """The greater of a and b; b where a is NaN."""
    return builder.select(builder.fcmp_ordered(">", a, b), a, b)


@_emitted(float_lanes, float_lanes)
def minimum(builder, a, b):
    """The lesser of a and b; b where a is NaN."""
    return builder.select(builder.fcmp_ordered("<", a, b), a, b)


multiply_add = _emitted(float_lanes, float_lanes, float_lanes)(_multiply_add)


@_emitted(float_lanes, float_lanes, float_lanes, float_lanes)
def where_at_least(builder, a, b, yes, no):
    """`yes` where a >= b, else `no` (also where a or b is NaN)."""
    return builder.select(builder.fcmp_ordered(">=", a, b), yes, no)


@_emitted(gives=double_lanes)
def zero_sum(builder):
    """Sixteen float64 zeros: the start of a sum."""
    return ir.Constant(DOUBLES, None)


@_emitted(double_lanes, float_lanes, gives=double_lanes)
def accumulate(builder, total, value):
    """Sixteen float64 running sums plus sixteen float32."""
    return builder.fadd(total, builder.fpext(value, DOUBLES))


@_emitted(double_lanes, gives=types.float64)
def sum_lanes(builder, total):
    """The sum of sixteen float64, in a fixed order."""
    index = ir.IntType(32)
    terms = [builder.extract_element(total, ir.Constant(index, k)) for k in range(LANES)]
    while len(terms) > 1:
        half = len(terms) // 2
        terms = [builder.fadd(terms[k], terms[k + half]) for k in range(half)]
    return terms[0]


@_emitted(float_lanes)
def reciprocal(builder, a):
    """1 / a to the last bit or the last but one; an estimate and a Newton step where that is faster than dividing."""
    one = _constant(1.0)
    if not machine_has("avx512f"):  # which has reciprocals of 14 bits
        return builder.fdiv(one, a)
    mask = ir.IntType(16)
    kind = ir.FunctionType(FLOATS, [FLOATS, FLOATS, mask])
    estimate = cgutils.get_or_insert_function(builder.module, kind, "llvm.x86.avx512.rcp14.ps.512")
    first = builder.call(estimate, [a, one, ir.Constant(mask, -1)])
    error = _multiply_add(builder, builder.fneg(a), first, one)
    return _multiply_add(builder, first, error, first)


@_emitted(float_lanes)
def square_root(builder, a):
    """The square root; NaN of a negative number."""
    return _call(builder, "sqrt", a)


@_emitted(float_lanes)
def absolute(builder, a):
    """The absolute value."""
    return _call(builder, "fabs", a)


@_emitted(float_lanes)
def exponential(builder, x):
    """e^x for x <= 0, relative error 1e-7; e^-87 below -87."""
    return _exponential(builder, x)


def _exponential(builder, x):
    least = _constant(-87.0)
    x = builder.select(builder.fcmp_ordered(">", x, least), x, least)
    n = _call(builder, "rint", builder.fmul(x, _constant(1.4426950408889634)))
    r = _multiply_add(builder, n, _constant(-0.693359375), x)
    r = _multiply_add(builder, n, _constant(2.12194440e-4), r)
    p = _constant(1.9875691500e-4)  # Cephes' expf
    for term in (1.3981999507e-3, 8.3334519073e-3, 4.1665795894e-2, 1.6666665459e-1, 5.0000001201e-1):
        p = _multiply_add(builder, p, r, _constant(term))
    p = _multiply_add(builder, p, builder.fmul(r, r), builder.fadd(r, _constant(1.0)))
    power = builder.shl(builder.add(builder.fptosi(n, INTEGERS), _integer(127)), _integer(23))
    return builder.fmul(p, builder.bitcast(power, FLOATS))


@_emitted(float_lanes)
def logarithm(builder, x):
    """The natural logarithm of a normal positive number, relative error 1e-7."""
    bits = builder.bitcast(x, INTEGERS)
    # split at sqrt(1/2) so that the mantissa minus one is small on both sides
    shifted = builder.sub(bits, _integer(0x3F3504F3))
    exponent = builder.sitofp(builder.ashr(shifted, _integer(23)), FLOATS)
    mantissa = builder.add(builder.and_(shifted, _integer(0x007FFFFF)), _integer(0x3F3504F3))
    m = builder.fsub(builder.bitcast(mantissa, FLOATS), _constant(1.0))
    square = builder.fmul(m, m)
    p = _constant(7.0376836292e-2)  # Cephes' logf
    for term in (-1.1514610310e-1, 1.1676998740e-1, -1.2420140846e-1, 1.4249322787e-1,
                 -1.6668057665e-1, 2.0000714765e-1, -2.4999993993e-1, 3.3333331174e-1):  # fmt: skip
        p = _multiply_add(builder, p, m, _constant(term))
    y = builder.fmul(builder.fmul(p, m), square)
    y = _multiply_add(builder, exponent, _constant(-2.12194440e-4), y)
    y = _multiply_add(builder, square, _constant(-0.5), y)
    return _multiply_add(builder, exponent, _constant(0.693359375), builder.fadd(y, m))


@_emitted(float_lanes, float_lanes)
def log_of_sum(builder, a, b):
    """log(e^a + e^b), absolute error 2e-7 beside that of the greater, which alone counts where they are more than
    WIDE_APART apart: a third of the time where all sixteen are."""
    larger = builder.select(builder.fcmp_ordered(">", a, b), a, b)
    apart = _call(builder, "fabs", builder.fsub(a, b))
    wide = builder.fcmp_unordered(">", apart, _constant(WIDE_APART))  # NaN, too: padding, whatever comes of it
    mask, begin = ir.IntType(LANES), builder.block
    with builder.if_then(builder.icmp_unsigned("!=", builder.bitcast(wide, mask), ir.Constant(mask, -1))):
        e = _exponential(builder, builder.fneg(apart))
        p = _constant(-6.4526113070e-3)  # log(1 + e) / e for e from 0 to 1, the greatest error of log(1 + e) least
        for term in (3.6084514068e-2, -9.5322480205e-2, 1.6764784363e-1, -2.4073074841e-1, 3.3179825164e-1,
                     -4.9987404449e-1, 9.9999642353e-1):  # fmt: skip
            p = _multiply_add(builder, p, e, _constant(term))
        closely, end = builder.select(wide, larger, _multiply_add(builder, p, e, larger)), builder.block
    result = builder.phi(FLOATS)
    result.add_incoming(larger, begin)
    result.add_incoming(closely, end)
    return result


class _WindowType(types.Type):
    """The numba type of 2 radius + 1 lanes: what a blur sees of the rows around one row."""

    def __init__(self, radius: int) -> None:
        self.radius = radius
        super().__init__(f"window{radius}")


@register_model(_WindowType)
class _WindowModel(models.PrimitiveModel):
    def __init__(self, manager, numba_type):
        super().__init__(manager, numba_type, ir.ArrayType(FLOATS, 2 * numba_type.radius + 1))


@intrinsic(prefer_literal=True)
def new_window(typing, value, radius):
    """A window all of whose rows are `value`; radius a literal."""
    if not isinstance(radius, types.IntegerLiteral):
        return None
    window = _WindowType(radius.literal_value)

    def generate(context, builder, signature, arguments):
        result = ir.Constant(ir.ArrayType(FLOATS, 2 * window.radius + 1), ir.Undefined)
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
            return _load(builder, _address(context, builder, signature.args[0], array, row, shifted))

        pairs = [(at(-k), at(k)) for k in range(1, count + 1)]
        return _symmetric_sum(builder, weights, at(0), pairs)

    return float_lanes(array, types.int64, types.int64, taps, radius), generate


def _symmetric_sum(builder, taps, centre, pairs):
    """taps[0] centre + sum_k taps[k] (left_k + right_k), in one fixed order."""
    value = builder.fmul(taps[0], centre)
    for tap, (left, right) in zip(taps[1:], pairs, strict=True):
        value = _multiply_add(builder, tap, builder.fadd(left, right), value)
    return value


def _taps(context, builder, array_type, array, count):
    struct = context.make_array(array_type)(context, builder, array)
    index = ir.IntType(64)
    return [_splat(builder, builder.load(builder.gep(struct.data, [ir.Constant(index, k)]))) for k in range(count)]
