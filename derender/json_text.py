"""JSON that a user gave: no key twice, no nesting that exhausts a stack, each value of its kind."""

import json
import math
import sys
from collections import Counter
from typing import Any

from derender.errors import DerenderError, at_fault

MOST_DEPTH = 64  # a scene, a camera or a header nests at most ten deep


def parse_json(text: str | bytes, where: object = None) -> Any:
    """Return the tree of a JSON text.

    Raises DerenderError : it is no JSON, a key stands twice in one object, or it is nested deeper than MOST_DEPTH.
    """
    try:
        with at_fault(where):
            tree = json.loads(text, object_pairs_hook=without_duplicates)
        if _depth(tree) > MOST_DEPTH:
            raise RecursionError
    except RecursionError:
        raise DerenderError(f"the JSON is nested more than {MOST_DEPTH} deep", where, "write it again") from None
    except ValueError as error:
        raise DerenderError(f"this is not JSON ({error})", where, "write it again") from error
    return tree


def _depth(tree: Any) -> int:
    inside = tree.values() if isinstance(tree, dict) else tree if isinstance(tree, list) else None
    return 0 if inside is None else 1 + max(map(_depth, inside), default=0)


def without_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return pairs of names and values as a mapping; DerenderError where a name stands twice."""
    tree = dict(pairs)
    if len(tree) < len(pairs):
        ((twice, _),) = Counter(key for key, _ in pairs).most_common(1)
        raise DerenderError(f"the key {twice!r} stands twice", remedy="keep one of them")
    return tree


def finite_or_none(value: Any) -> Any:
    """Return what JSON can hold of a number: None for nan and infinity; anything else as it is."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


def misfit(tree: Any, form: Any, place: str = "it") -> str:
    """Return the first place of a JSON tree that is not of a form, such as "meta.spots.0"; "" where all is.

    form : float, any finite number; None or another type; {form, form}, any of these; [form], a list of such; (form,
        form), a list of this length; {"one": form, "other?": form, str: form}, an object with these keys, the second if
        it has one, and with any others for the third; where that is missing, what they hold does not count.
    """
    if isinstance(form, set):
        return "" if any(not misfit(tree, each) for each in form) else place
    if form is float:
        number = isinstance(tree, int | float) and not isinstance(tree, bool)
        return "" if number and abs(tree) <= sys.float_info.max else place
    if isinstance(form, dict) and isinstance(tree, dict):
        named = {key.removesuffix("?"): each for key, each in form.items() if key is not str}
        lacking = [f"{place}.{key}" for key in form if key in named and key not in tree]
        inside = [(key, each, named.get(key, form.get(str, object))) for key, each in tree.items()]
    elif isinstance(form, list | tuple) and isinstance(tree, list):
        lacking = [place] if isinstance(form, tuple) and len(tree) != len(form) else []
        inside = [(k, each, form[k % len(form)]) for k, each in enumerate(tree)]
    else:
        return "" if tree is form or (isinstance(form, type) and isinstance(tree, form)) else place
    return next(filter(None, (*lacking, *(misfit(each, its, f"{place}.{key}") for key, each, its in inside))), "")
