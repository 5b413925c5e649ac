"""Kernels called through their addresses."""

import numpy as np
import pytest

from derender.compilation import cache, entries
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


def corner(rows, k):
    row = rows[k]
    return total(row[:2], row[2]) + total(row[2:], row[0])


@njit
def total(row, more):
    if more < 0.0:
        raise ValueError("a negative number")
    return row.sum() + more


def test_who_borrows_counts_no_references_and_makes_no_arrays():
    """Counting them by locked instructions once took half of a walk's time."""
    rows, counted = np.arange(12.0).reshape(3, 4), {}
    for borrows in (True, False):
        kernel = njit(corner, borrows=borrows)
        assert kernel(rows, 1) == 4.0 + 5.0 + 6.0 + 6.0 + 7.0 + 4.0
        counted[borrows] = "".join(kernel.dispatcher.inspect_llvm().values()).count("call void @NRT_")
    assert counted[True] == 0 < counted[False]
    with pytest.raises(Exception, match="Only accept returning"):
        njit(lambda rows: rows[0], borrows=True)(rows)
    with pytest.raises(Exception, match="NRT"):
        njit(lambda rows: np.empty(3).sum(), borrows=True)(rows)


def test_what_is_bound_to_types_is_called_without_a_look_at_them(monkeypatch):
    """Of nested arrays that takes longer than many a kernel: a walk that Python drives did so five times a step."""
    kernel = njit(lambda values, factor: factor * values.sum())
    assert kernel(np.ones(3), 2.0) == 6.0
    bound = kernel.bound(np.ones(3), 2.0)

    def looked(value):
        raise AssertionError("it was looked at")

    monkeypatch.setattr(cache, "fingerprint", looked)
    monkeypatch.setattr(entries, "fingerprint", looked)
    assert bound(np.ones(4), 3.0) == 12.0
