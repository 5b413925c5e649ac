"""What the scripts are told: types for argparse, so that a wrong word is one line, before any work."""

import argparse
import json
from pathlib import Path

from derender.errors import DerenderError


def at_least_one(text):
    """Return a whole number, at least 1."""
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"{text} is less than 1")
    return number


def pixels(text):
    """Return (width, height) of a text such as 64x48."""
    width, height = text.split("x")
    return at_least_one(width), at_least_one(height)


def target(text):
    """Return the Path of a file that is to be written into a folder that is there."""
    path = Path(text)
    if path.is_dir() or not path.parent.is_dir():
        raise argparse.ArgumentTypeError(f"{text} is no file in a folder that is there")
    return path


def names_in(text, known, what):
    """Return the names in a text, with commas between, all of which are known; of an empty one all that are."""
    names = [name for name in text.split(",") if name] or list(known)
    if unknown := [name for name in names if name not in known]:
        raise DerenderError(f"no such {what}: {', '.join(unknown)}", remedy=f"choose from {', '.join(known)}")
    return names


def read_records(path):
    """Return what the lines of a file of JSON say."""
    try:
        return [json.loads(line) for line in path.read_text().splitlines()]
    except ValueError as error:
        raise DerenderError(f"not a file of records, one line of JSON each: {error}", path) from None
