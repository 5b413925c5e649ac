"""Compiled kernels called through their addresses.

What a kernel calls by name is compiled into it a second time: seconds, for something as large as the engine. A call
through an address costs a nanosecond, and its target is compiled once. An address holds in one process only: it is
looked up when a state is made and never kept in a file.
"""

from numba import typeof, types
from numba.core import cgutils
from numba.extending import intrinsic


def address_of(kernel, *arguments) -> int:
    """Return where the version of a kernel for arguments of these types lies in this process."""
    kinds = tuple(typeof(argument) for argument in arguments)
    kernel.compile(kinds)
    result = kernel.overloads[kinds]
    return result.library.get_pointer_to_function(result.fndesc.llvm_func_name)


def _call(result, kinds):
    """Return the signature and the code of a call of an address: (address, *arguments) -> result."""
    if any(isinstance(kind, types.Array) and kind.layout != "C" for kind in kinds):
        raise TypeError(f"the kernel was compiled for C-contiguous arrays, not for {kinds}")

    def generate(context, builder, signature, values):
        convention = context.call_conv
        pointer = convention.get_function_type(result, kinds).as_pointer()
        function = builder.inttoptr(values[0], pointer)
        status, answer = convention.call_function(builder, function, result, kinds, values[1:])
        with cgutils.if_unlikely(builder, status.is_error):
            convention.return_status_propagate(builder, status)
        return answer

    return result(types.int64, *kinds), generate


@intrinsic
def call_for_number(typing, address, a, b, c, d, e):
    """Call the kernel at `address` with five arguments; it returns a float64."""
    return _call(types.float64, (a, b, c, d, e))


@intrinsic
def call_for_nothing(typing, address, a, b):
    """Call the kernel at `address` with two arguments; it returns nothing."""
    return _call(types.none, (a, b))
