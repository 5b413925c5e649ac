"""Registries of named types: shapes, contacts, distributions, likelihoods, kernels; and what a parameter of one is.

Another package adds a type by an entry point in the registry's group; naming it there is enough.
"""

import difflib
import functools
import inspect
import math
import numbers
import reprlib
from collections.abc import Callable, Iterator, Sequence
from types import UnionType
from typing import Any, Generic, NamedTuple, ParamSpec, TypeVar, get_args, get_origin

from derender.errors import DerenderError

P = ParamSpec("P")
T = TypeVar("T")


class Parameter(NamedTuple):
    """A continuous parameter of a registered type.

    name : key in scene files and last part of its address (``theta``).
    unit : "m", "rad" or "" for a pure number.
    lower, upper : range of meaningful values; a file outside it is at fault.
    default : value where a file says nothing, or None where a file must say it.
    period : length after which the value repeats, or None.
    slack : True for a number that is fixed at its default in an ideal contact (the gap, the tilts, the
        angle of a disc): it counts as a degree of freedom only where a scene gives it.
    """

    name: str
    unit: str = ""
    lower: float = -math.inf
    upper: float = math.inf
    default: float | None = None
    period: float | None = None
    slack: bool = False


class Registry(Generic[T]):
    """Names to types of one kind.

    kind : what the entries are, in the singular ("shape"), for error messages.
    entry_point_group : group in which other packages announce theirs ("derender.shapes");
        each entry point is a module or object whose import registers it.
    late : modules of derender that register further types, in rooms that may not be imported before one is wanted.
    make : what is kept of a class that is registered; an instance where not told otherwise.
    """

    def __init__(
        self, kind: str, entry_point_group: str, late: tuple[str, ...] = (), make: Callable = lambda cls: cls()
    ) -> None:
        self.late, self.make = late, make
        self.kind = kind
        self.entry_point_group = entry_point_group
        self._entries: dict[str, T] = {}
        self._loaded = False

    def register(self, name: str) -> Callable[[type], type]:
        """Class decorator: put what `make` gives of the class under `name`. A name can be taken once."""

        def decorate(cls: type) -> type:
            if name in self._entries:
                raise ValueError(f"the {self.kind} {name!r} is registered already")
            entry = self.make(cls)
            entry.name = name
            self._entries[name] = entry
            return cls

        return decorate

    def _load(self) -> None:
        if not self._loaded:
            self._loaded = True
            from importlib import import_module
            from importlib.metadata import entry_points  # a hundredth of a second

            for module in self.late:
                import_module(module)
            for point in entry_points(group=self.entry_point_group):
                point.load()

    def __getitem__(self, name: str) -> T:
        if name not in self._entries:
            self._load()
        try:
            return self._entries[name]
        except (KeyError, TypeError):
            raise DerenderError(f"no {self.kind} is called {name!r}", remedy=suggest(name, self._entries)) from None

    def __contains__(self, name: object) -> bool:
        if name not in self._entries:
            self._load()
        return name in self._entries

    def __iter__(self) -> Iterator[str]:
        """Yield the registered names, sorted."""
        self._load()
        return iter(sorted(self._entries))


def only_its_keywords(function: Callable[P, T]) -> Callable[P, T]:
    """Return the function with a TypeError in one line for a keyword that it does not have ("did you mean"), and for an
    argument of another type than it is annotated with.
    """
    signature = inspect.signature(function)
    names = [name for name in signature.parameters if name not in ("self", "cls")]

    @functools.wraps(function)
    def checked(*arguments: P.args, **keywords: P.kwargs) -> T:
        for key in keywords:
            if key not in names:
                raise TypeError(f"{function.__name__}() has no keyword {key!r}; {suggest(key, names)}")
        for name, value in signature.bind_partial(*arguments, **keywords).arguments.items():
            kind = signature.parameters[name].annotation
            kinds = get_args(kind) if isinstance(kind, UnionType) else (kind,)
            if not any(_is_a(value, kind) for kind in kinds):
                wanted = " or ".join(TYPES.get(kind, str(getattr(kind, "__name__", kind))) for kind in kinds)
                raise TypeError(f"{function.__name__}(): {name} is {reprlib.repr(value)}; give {wanted}")
        return function(*arguments, **keywords)

    return checked


# How a person says some types; no whole number of the interface may be negative.
TYPES = {int: "a whole number from 0 up", float: "a number", str: "text", bool: "True or False", type(None): "None"}


def _is_a(value: object, kind: Any) -> bool:
    """Return whether a value is of a type of an annotation, numbers of any library included; text is no sequence."""
    kind = get_origin(kind) or kind
    if kind is int or kind is float:
        if isinstance(value, bool) or not isinstance(value, numbers.Real):
            return False
        return kind is float or (isinstance(value, numbers.Integral) and int(value) >= 0)
    if getattr(kind, "__name__", "") == "ndarray":
        return hasattr(value, "__array__")
    if kind is inspect.Parameter.empty or not isinstance(kind, type):
        return True
    return isinstance(value, kind) and not (kind is Sequence and isinstance(value, str))


def suggest(name: object, choices: Any) -> str:
    """Return "did you mean X?" where a choice is near, else the list of choices."""
    choices = sorted(map(str, choices))
    near = difflib.get_close_matches(str(name), choices, n=1)
    return f"did you mean {near[0]!r}?" if near else "choose from " + ", ".join(choices)
