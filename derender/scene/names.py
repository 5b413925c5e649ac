"""What an object may be called: a part of an address, safe to print."""

import re

NAME = re.compile(r"[^\W_][\w -]{0,63}")
RESERVED = ("root", "likelihood", "camera")  # that addresses begin with besides objects


def is_name(name: object) -> bool:
    """Return whether this may name an object."""
    return isinstance(name, str) and NAME.fullmatch(name) is not None and name not in RESERVED
