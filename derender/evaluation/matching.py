"""Which predicted object is which true one."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from derender.evaluation.convex import intersection_over_union

# Two planes are the same support within these: wider than any depth sensor's error, narrower than a stair.
PLANE_ANGLE = np.deg2rad(15.0)
PLANE_DISTANCE = 0.03

WITHOUT_EXTENT = ("plane", "frame")


def solids_of(scene: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Return the objects of a scene that have an extent."""
    return [item for item in scene["objects"] if item["type"] not in WITHOUT_EXTENT and item.get("size") is not None]


def planes_of(scene: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Return the planes of a scene."""
    return [item for item in scene["objects"] if item["type"] == "plane"]


def iou_matrix(predicted: Sequence[Mapping[str, Any]], truth: Sequence[Mapping[str, Any]]) -> np.ndarray:
    """Return the intersection over union of each predicted solid with each true one, (P, T) float64."""
    overlap = np.zeros((len(predicted), len(truth)))
    for i, a in enumerate(predicted):
        for j, b in enumerate(truth):
            overlap[i, j] = intersection_over_union(a, b)
    return overlap


def assign(overlap: np.ndarray, threshold: float) -> list[tuple[int, int]]:
    """Return the one-to-one pairs with the most members, each overlapping at least `threshold`.

    Among pairings of the same number the one with the greatest summed overlap is taken (Hungarian algorithm).

    Parameters
    ----------
    overlap : (P, T) float64 in [0, 1].
    """
    if overlap.size == 0:
        return []
    from scipy.optimize import linear_sum_assignment

    # One more pair outweighs any difference in overlap.
    value = np.where(overlap >= threshold, 1 + min(overlap.shape) + overlap, 0.0)
    rows, columns = linear_sum_assignment(value, maximize=True)
    return [
        (int(row), int(column))
        for row, column in zip(rows, columns, strict=True)
        if overlap[row, column] >= threshold and overlap[row, column] > 0
    ]


def match_solids(predicted: Mapping[str, Any], truth: Mapping[str, Any], threshold: float = 0.5) -> dict[str, str]:
    """Return which true solid each predicted solid is: names to names, one to one, IoU at least `threshold`."""
    left, right = solids_of(predicted), solids_of(truth)
    return {left[i]["name"]: right[j]["name"] for i, j in assign(iou_matrix(left, right), threshold)}


def match_planes(predicted: Mapping[str, Any], truth: Mapping[str, Any]) -> dict[str, str]:
    """Return which true plane each predicted plane is.

    Planes have no volume: two match where their normals differ by at most 15 degrees (whichever way they point) and the
    predicted plane passes within 3 cm of the foot of the true scene on the true plane.
    """
    left, right = planes_of(predicted), planes_of(truth)
    centres = [np.asarray(item["pose"], float)[:3, 3] for item in solids_of(truth)]
    agreement = np.zeros((len(left), len(right)))
    for i, a in enumerate(left):
        for j, b in enumerate(right):
            pose_a, pose_b = np.asarray(a["pose"], float), np.asarray(b["pose"], float)
            normal = pose_b[:3, 2]
            middle = np.mean(centres, axis=0) if centres else pose_b[:3, 3]
            foot = middle - normal * float(normal @ (middle - pose_b[:3, 3]))
            angle = np.arccos(np.clip(abs(pose_a[:3, 2] @ normal), 0, 1))
            distance = abs(float(pose_a[:3, 2] @ (foot - pose_a[:3, 3])))
            if angle <= PLANE_ANGLE and distance <= PLANE_DISTANCE:
                agreement[i, j] = 1 - 0.5 * angle / PLANE_ANGLE - 0.49 * distance / PLANE_DISTANCE
    return {left[i]["name"]: right[j]["name"] for i, j in assign(agreement, 0.0)}


def f1(hits: int, predicted: int, truth: int) -> float:
    """Return the harmonic mean of precision and recall; 1 where there was nothing to find and nothing was said."""
    return 2 * hits / (predicted + truth) if predicted + truth else 1.0
