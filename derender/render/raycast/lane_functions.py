"""Functions of sixteen float32 side by side (`lanes`): reciprocal, square root, exponential, logarithm."""

from llvmlite import ir
from numba.core import cgutils
from numba.extending import intrinsic

from derender.render.raycast import lane_code as code
from derender.render.raycast.lanes import float_lanes, greater_of, machine_has


@intrinsic
def reciprocal(typing, a):
    """1 / a to the last bit or the last but one; an estimate and a Newton step where that is faster than dividing."""

    def generate(context, builder, signature, arguments):
        one, value = code.constant(1.0), arguments[0]
        if not machine_has("avx512f"):  # which has reciprocals of 14 bits
            return builder.fdiv(one, value)
        mask = ir.IntType(16)
        kind = ir.FunctionType(code.FLOATS, [code.FLOATS, code.FLOATS, mask])
        estimate = cgutils.get_or_insert_function(builder.module, kind, "llvm.x86.avx512.rcp14.ps.512")
        first = builder.call(estimate, [value, one, ir.Constant(mask, -1)])
        error = code.multiply_add(builder, builder.fneg(value), first, one)
        return code.multiply_add(builder, first, error, first)

    return float_lanes(float_lanes), generate


@intrinsic
def square_root(typing, a):
    """The square root; NaN of a negative number."""

    def generate(context, builder, signature, arguments):
        return code.call(builder, "sqrt", arguments[0])

    return float_lanes(float_lanes), generate


@intrinsic
def absolute(typing, a):
    """The absolute value."""

    def generate(context, builder, signature, arguments):
        return code.call(builder, "fabs", arguments[0])

    return float_lanes(float_lanes), generate


@intrinsic
def exponential(typing, x):
    """e^x for x <= 0, relative error 1e-7; e^-87 below -87."""

    def generate(context, builder, signature, arguments):
        x = greater_of(builder, arguments[0], code.constant(-87.0))
        n = code.call(builder, "rint", builder.fmul(x, code.constant(1.4426950408889634)))
        r = code.multiply_add(builder, n, code.constant(-0.693359375), x)
        r = code.multiply_add(builder, n, code.constant(2.12194440e-4), r)
        p = code.constant(1.9875691500e-4)  # Cephes' expf
        for term in (1.3981999507e-3, 8.3334519073e-3, 4.1665795894e-2, 1.6666665459e-1, 5.0000001201e-1):
            p = code.multiply_add(builder, p, r, code.constant(term))
        p = code.multiply_add(builder, p, builder.fmul(r, r), builder.fadd(r, code.constant(1.0)))
        power = builder.shl(builder.add(builder.fptosi(n, code.INTEGERS), code.integer(127)), code.integer(23))
        return builder.fmul(p, builder.bitcast(power, code.FLOATS))

    return float_lanes(float_lanes), generate


@intrinsic
def logarithm(typing, x):
    """The natural logarithm of a normal positive number, relative error 1e-7."""

    def generate(context, builder, signature, arguments):
        bits = builder.bitcast(arguments[0], code.INTEGERS)
        # split at sqrt(1/2) so that the mantissa minus one is small on both sides
        shifted = builder.sub(bits, code.integer(0x3F3504F3))
        exponent = builder.sitofp(builder.ashr(shifted, code.integer(23)), code.FLOATS)
        mantissa = builder.add(builder.and_(shifted, code.integer(0x007FFFFF)), code.integer(0x3F3504F3))
        m = builder.fsub(builder.bitcast(mantissa, code.FLOATS), code.constant(1.0))
        square = builder.fmul(m, m)
        p = code.constant(7.0376836292e-2)  # Cephes' logf
        for term in (
            -1.1514610310e-1,
            1.1676998740e-1,
            -1.2420140846e-1,
            1.4249322787e-1,
            -1.6668057665e-1,
            2.0000714765e-1,
            -2.4999993993e-1,
            3.3333331174e-1,
        ):
            p = code.multiply_add(builder, p, m, code.constant(term))
        y = builder.fmul(builder.fmul(p, m), square)
        y = code.multiply_add(builder, exponent, code.constant(-2.12194440e-4), y)
        y = code.multiply_add(builder, square, code.constant(-0.5), y)
        return code.multiply_add(builder, exponent, code.constant(0.693359375), builder.fadd(y, m))

    return float_lanes(float_lanes), generate
