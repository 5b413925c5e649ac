"""Functions that say what was meant when a keyword is not theirs."""

import functools
import inspect
from collections.abc import Callable
from typing import ParamSpec, TypeVar

from derender.registry import suggest

P = ParamSpec("P")
R = TypeVar("R")


def only_its_keywords(function: Callable[P, R]) -> Callable[P, R]:
    """Return the function with a TypeError that says "did you mean" for a keyword that it does not have."""
    names = list(inspect.signature(function).parameters)

    @functools.wraps(function)
    def checked(*arguments: P.args, **keywords: P.kwargs) -> R:
        for key in keywords:
            if key not in names:
                raise TypeError(f"{function.__name__}() has no keyword {key!r}; {suggest(key, names)}")
        return function(*arguments, **keywords)

    return checked
