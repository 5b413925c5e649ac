"""What is said to a user of commands, in the words of Python: `--method smc` is `method="smc"` there."""

import functools
import re
from collections.abc import Callable
from typing import ParamSpec, TypeVar

from derender.errors import DerenderError

P = ParamSpec("P")
T = TypeVar("T")
# Options whose keyword has another name, or stands elsewhere.
KEYWORDS = {"scene": "prior="}
# An option, and the value beside it: any text of an intervention, a word or number of others. A file's metavar is none.
OPTION = re.compile(
    r"--(?:(push|remove|add|tilt|shake|jitter)[ =]((?:[\w+-]+:|\d)\S*[^\s:])"
    r"|([a-z][a-z-]*)(?:[ =](auto|mcmc|map|smc|none|[-\d][\d.,e-]*)| FILE)?)"
)


def in_python(line: str) -> str:
    """Return a line in which options of commands stand as the keywords of functions.

    >>> in_python("--method smc is for objects that are given; add --scene, or take --method mcmc")
    'method="smc" is for objects that are given; add prior=, or take method="mcmc"'
    """

    def keyword(match: re.Match[str]) -> str:
        name, value = match[1] or match[3], match[2] or match[4]
        spelt = KEYWORDS.get(name, name.replace("-", "_") + "=")
        if value is None:
            return spelt
        number = match[4] and re.fullmatch(r"[-\d.,e]+", value)
        return spelt + (f"({value})" if number and "," in value else value if number else f'"{value}"')

    return OPTION.sub(keyword, line)


def in_pythons_words(function: Callable[P, T]) -> Callable[P, T]:
    """Return the function with every DerenderError that it raises in the words of Python."""

    @functools.wraps(function)
    def worded(*arguments: P.args, **keywords: P.kwargs) -> T:
        try:
            return function(*arguments, **keywords)
        except DerenderError as error:
            parts = (part if part is None else in_python(str(part)) for part in (error.what, error.where, error.remedy))
            raise DerenderError(*parts) from error  # type: ignore[arg-type]

    return worded
