"""JSON that a user gave: no key twice, no nesting that exhausts a stack."""

import json
from typing import Any

from derender.errors import DerenderError

MOST_DEPTH = 64  # a scene, a camera or a header nests at most ten deep


def parse_json(text: str | bytes, where: object = None) -> Any:
    """Return the tree of a JSON text.

    Raises DerenderError : it is no JSON, a key stands twice in one object, or it is nested deeper than MOST_DEPTH.
    """
    try:
        tree = json.loads(text, object_pairs_hook=_without_duplicates)
    except DerenderError as error:
        raise DerenderError(error.what, where, error.remedy) from None
    except RecursionError:
        raise _too_deep(where) from None
    except ValueError as error:
        raise DerenderError(f"this is not JSON ({error})", where, "write it again") from None
    level = [tree]
    for _ in range(MOST_DEPTH):
        level = [item for node in level if isinstance(node, (dict, list)) for item in _items(node)]
        if not level:
            return tree
    raise _too_deep(where)


def _items(node: dict | list) -> Any:
    return node.values() if isinstance(node, dict) else node


def _too_deep(where: object) -> DerenderError:
    return DerenderError(f"the JSON is nested more than {MOST_DEPTH} deep", where, "write it again")


def _without_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    tree = dict(pairs)
    if len(tree) < len(pairs):
        seen: set[str] = set()
        twice = next(key for key, _ in pairs if key in seen or seen.add(key))  # type: ignore[func-returns-value]
        raise DerenderError(f"the key {twice!r} stands twice", remedy="keep one of them")
    return tree
