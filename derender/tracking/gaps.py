"""Frames that a film should have and has not: dropped ones, and ones that were written twice.

A film is followed as if its frames came at even times: a gap would show everything twice as fast for a frame. So what
is missing is put in as a frame without depth.
"""

import re
from collections.abc import Sequence

import numpy as np

# Numbers in names count frames where all their steps are within this of a multiple of the usual one.
NEARLY = 0.1
# Frames are put in where a film is then at most so many times as long: else its times are no film's.
LONGER = 2.0
# A frame that is the one before, bit by bit, was not taken anew where between other frames this share of the pixels
# changes: noise changes nearly all, a rendering without noise what moves.
CHANGES = 0.5
MISSING = "missing"  # what a frame is called that is put in


def counted(names: Sequence[str]) -> np.ndarray:
    """Return which frames (T,) names say that these are, in steps of the usual one; where they do not, one by one."""
    plain = np.arange(len(names), dtype=float)
    numbers = [re.findall(r"\d+\.\d+|\d+", name) for name in names]
    if len({len(row) for row in numbers}) > 1:
        return plain
    varying = [np.array(column, float) for column in zip(*numbers, strict=True) if len(set(column)) > 1]
    if len(varying) != 1 or (usual := float(np.median(np.diff(varying[0])))) <= 0:
        return plain
    steps = np.diff(varying[0]) / usual
    if steps.min() < 1 - NEARLY or np.abs(steps - np.round(steps)).max() > NEARLY:
        return plain
    return np.concatenate([[0.0], np.cumsum(np.round(steps))])


def repeated(frames: Sequence[np.ndarray]) -> list[int]:
    """Return the numbers of the frames that repeat the one before, where noise would have changed them."""
    pairs = zip(frames[:-1], frames[1:], strict=True)
    changed = [float(np.mean(np.nan_to_num(before) != np.nan_to_num(after))) for before, after in pairs]
    others = [share for share in changed if share > 0]
    if not others or np.median(others) < CHANGES:
        return []
    return [t + 1 for t, share in enumerate(changed) if share == 0 and np.any(frames[t + 1] > 0)]


def lacking(times: np.ndarray) -> np.ndarray:
    """Return how many frames (T,) are missing before each one, by their times (T,)."""
    steps = np.diff(times, prepend=times[0])
    usual = np.median(steps[1:]) if len(steps) > 1 else 1.0
    found = np.maximum(np.round(steps / usual).astype(int) - 1, 0)
    return found if found.sum() <= (LONGER - 1) * len(times) else np.zeros(len(times), int)
