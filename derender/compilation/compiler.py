"""Kernels compiled by numba: the one file that imports it, in processes that have something to compile.

What a kernel calls by name is compiled with it, from its source; nothing but the whole is kept.
"""

import functools
import importlib
import pickle
import signal

import numba
from numba import typeof, types
from numba.core import cgutils, config
from numba.core.registry import cpu_target
from numba.extending import intrinsic, overload, typeof_impl
from numba.np import arrayobj

from derender.compilation import cache as kernel_cache
from derender.compilation import entries
from derender.compilation.entries import Code, Version
from derender.compilation.threads import interruptible


def compile_version(kernel, arguments, path) -> Version:
    """Compile a kernel for arguments of these types, write the entry if there is a path, and return the version.

    Ctrl-C waits for its end: in one of LLVM's callbacks it would be lost.
    """
    with interruptible() as stop:
        version = _compiled(kernel, arguments, path)
    if stop.is_set():
        signal.raise_signal(signal.SIGINT)
    return version


def _compiled(kernel, arguments, path) -> Version:
    if vars(config)["DISABLE_JIT"]:
        return Version(kernel.py_func, 0)
    kinds = tuple(typeof(argument) for argument in arguments)
    kernel.dispatcher.compile(kinds)
    result = kernel.dispatcher.overloads[kinds]
    if path:
        entries.write_entry(path, pickle.dumps(tuple(_code(kernel, result))))
    address = result.library.get_pointer_to_function(result.fndesc.llvm_func_name)
    return Version(result.entry_point, address)


def _code(kernel, result) -> Code:
    """Return what `load` needs of a compiled version."""
    own, others = result.environment, result.referenced_envs or result._find_referenced_environments()
    environments = [(each.env_name, each.globals["__name__"], list(each.consts)) for each in (own, *others)]
    wrapper = "" if kernel.targetoptions.get("no_cpython_wrapper") else result.fndesc.llvm_cpython_wrapper_name
    machine_code = result.library._get_compiled_object()
    return Code(result.fndesc.llvm_func_name, wrapper, kernel.__name__, machine_code, environments)


def make_dispatcher(kernel):
    """Return numba's dispatcher of a kernel."""
    dispatcher = numba.njit(**kernel.targetoptions)(kernel.py_func)
    template = dispatcher.get_call_template

    def for_any_value(arguments, keywords):
        """Take a constant that a caller gives for any value of its type: numba would compile each apart."""
        return template([types.unliteral(kind) for kind in arguments],
                        {name: types.unliteral(kind) for name, kind in keywords.items()})  # fmt: skip

    dispatcher.get_call_template = for_any_value
    return dispatcher


@typeof_impl.register(kernel_cache.Kernel)
def _kind_of_kernel(kernel, context):
    return types.Dispatcher(kernel.dispatcher)


@typeof_impl.register(kernel_cache.Late)
@functools.cache
def _kind_of_late(late, context):
    found = getattr(importlib.import_module(late.module), late.name)  # imported only now: it is new to numba
    cpu_target.typing_context.refresh()
    cpu_target.target_context.refresh()
    return cpu_target.typing_context.resolve_value_type(found)


def _raise_for_shapes(source, target):
    """Say that an array does not fit the part of another that it is assigned to."""


@overload(_raise_for_shapes)
def _compiled_raise_for_shapes(source, target):
    def implementation(source, target):
        raise ValueError("cannot assign an array of another shape to a slice")

    return implementation


# numba's own makes a text of both shapes: five seconds of each kernel's compilation that assigns an array to a slice.
arrayobj.raise_with_shape_context = _raise_for_shapes


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
