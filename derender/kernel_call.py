"""Compiled kernels called through their addresses.

What a kernel calls by name is compiled into it a second time: seconds, for something as large as the engine. A call
through an address costs a nanosecond, and its target is compiled once. An address holds in one process only: it is
looked up when a state is made and never kept in a file.
"""

import numpy as np
from numba import typeof, types
from numba.core import cgutils
from numba.extending import intrinsic


def address_of(kernel, *arguments) -> int:
    """Return where the version of a kernel for arguments of these types lies in this process; compiled if need be."""
    key = kernel, _kind(arguments)
    if key not in _addresses:
        kinds = tuple(typeof(argument) for argument in arguments)
        kernel.compile(kinds)
        result = kernel.overloads[kinds]
        _addresses[key] = result.library.get_pointer_to_function(result.fndesc.llvm_func_name)
    return _addresses[key]


_addresses: dict[tuple, int] = {}


def _kind(argument):
    """Return what tells types apart, a hundred times faster than numba does."""
    if isinstance(argument, np.ndarray):
        return argument.dtype, argument.ndim, argument.flags.c_contiguous, argument.flags.writeable
    return tuple(map(_kind, argument)) if isinstance(argument, tuple) else type(argument)


def _caller(result):
    """Return an intrinsic that calls an address: (address, *arguments) -> result."""

    @intrinsic
    def call(typing, address, *arguments):
        kinds = tuple(types.unliteral(kind) for kind in arguments)
        if any(isinstance(kind, types.Array) and kind.layout != "C" for kind in kinds):
            raise TypeError(f"the kernel was compiled for C-contiguous arrays, not for {kinds}")

        def generate(context, builder, signature, values):
            convention = context.call_conv
            pointer = convention.get_function_type(result, kinds).as_pointer()
            function = builder.inttoptr(values[0], pointer)
            given = cgutils.unpack_tuple(builder, values[1])
            status, answer = convention.call_function(builder, function, result, kinds, given)
            with cgutils.if_unlikely(builder, status.is_error):
                convention.return_status_propagate(builder, status)
            return answer

        return result(types.int64, types.StarArgTuple(arguments)), generate

    return call


call_for_nothing, call_for_number = _caller(types.none), _caller(types.float64)
call_for_two_numbers = _caller(types.UniTuple(types.float64, 2))
