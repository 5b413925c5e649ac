"""Kernels called through their addresses."""

import numpy as np
import pytest

from derender.compilation.cache import address_of, call_for_nothing, call_for_number, njit


@njit
def weighted(values, factor, more, less, count):
    if count < 0:
        raise ValueError("a negative count")
    return factor * values[:count].sum() + more.sum() - less.sum()


@njit
def double(values, factor):
    values *= factor


@njit
def through(address, values, count):
    return call_for_number(address, values, 2.0, values, values, count)


@njit
def through_for_nothing(address, values):
    call_for_nothing(address, values, 2.0)


def test_the_same_as_by_name_with_faults_passed_on():
    values = np.arange(4.0)
    address = address_of(weighted, values, 2.0, values, values, 0)
    assert through(address, values, 3) == weighted(values, 2.0, values, values, 3) == 6.0
    with pytest.raises(ValueError, match="a negative count"):
        through(address, values, -1)
    through_for_nothing(address_of(double, values, 2.0), values)
    assert values.tolist() == [0.0, 2.0, 4.0, 6.0]


def test_other_arrays_than_it_was_compiled_for_are_refused():
    """Broken twin: called with a strided array, the kernel would read what lies between."""
    values = np.arange(8.0)
    address = address_of(weighted, values, 2.0, values, values, 0)
    with pytest.raises(TypeError, match="C-contiguous"):
        through(address, values[::2], 3)
