"""Compiled kernels called through their addresses.

What a kernel calls by name is compiled into it a second time: seconds, for something as large as the engine. A call
through an address costs a nanosecond, and its target is compiled once. An address holds in one process only: it is
looked up when a state is made and never kept in a file.

In a kernel `call_for_number(address, *arguments)` calls one that returns a number.
"""

from derender.compilation.cache import late

call_for_nothing, call_for_number, call_for_two_numbers = late(
    "derender.compilation.compiler", "call_for_nothing", "call_for_number", "call_for_two_numbers"
)


def address_of(kernel, *arguments) -> int:
    """Return where the version of a kernel for arguments of these types lies in this process; compiled if need be."""
    return kernel.version(arguments).address
