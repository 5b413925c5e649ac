"""Comparisons of many scenes: which prediction goes with which truth, and the sums over all of them."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from derender.errors import DerenderError
from derender.evaluation.metrics import THRESHOLDS, f1

SCENE_SUFFIXES = (".yaml", ".yml", ".json")
LABEL_SUFFIXES = (".png", ".npy", ".tif", ".tiff")


def paired(predicted: str | Path, truth: str | Path) -> list[tuple[str, Path, Path]]:
    """Return (name, prediction, truth) of what is to be compared.

    Two files are a pair, whatever their names. In folders things of the same name go together: a prediction is a scene
    file or a folder with a scene.yaml in it (which is one scene), a truth one of these or a label image.

    Raises
    ------
    DerenderError : nothing is there, or a truth has no prediction (a missing one is not a zero to be averaged away).
    """
    left, right = Path(predicted), Path(truth)
    for path in (left, right):
        if str(path) != "-" and not path.exists():
            raise DerenderError("there is no such file or folder", path, "check the path")
    if _is_single(left) and _is_single(right):
        return [(left.stem if left.is_file() else left.name, left, right)]
    kinds = ((left, SCENE_SUFFIXES), (right, (*SCENE_SUFFIXES, *LABEL_SUFFIXES)))
    found, true = ({} if _is_single(path) else _scenes_in(path, suffixes) for path, suffixes in kinds)
    for path, inside in ((left, found), (right, true)):
        if not inside and not _is_single(path):
            raise DerenderError(
                "there is no scene in this folder", path, "scenes are .yaml or .json, label images .png"
            )
    if _is_single(left) != _is_single(right):
        raise DerenderError(
            "one is a folder of scenes, the other a single scene", left, "give two files or two folders"
        )
    missing = sorted(set(true) - set(found))
    if missing:
        some = ", ".join(missing[:5]) + (" ..." if len(missing) > 5 else "")
        raise DerenderError(f"{len(missing)} of {len(true)} scenes have no prediction: {some}", left)
    return [(name, found[name], true[name]) for name in sorted(true)]


def _is_single(path: Path) -> bool:
    return not path.is_dir() or (path / "scene.yaml").exists()


def _scenes_in(folder: Path, suffixes: Sequence[str]) -> dict[str, Path]:
    found: dict[str, Path] = {}
    # Of several files of one name the first kind in `suffixes` is taken: a scene before a picture of it.
    ordered = sorted(folder.iterdir(), key=lambda p: suffixes.index(p.suffix) if p.suffix in suffixes else -1)
    for path in ordered:
        if path.is_dir() and (path / "scene.yaml").exists():
            found.setdefault(path.name, path)
        elif path.is_file() and path.suffix in suffixes:
            found.setdefault(path.stem, path)
    return found


def totals(results: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """Return what many comparisons come to: F1 over all objects and edges, shares of scenes, medians of errors.

    Parameters
    ----------
    results : each as `metrics.compare_scenes` returns it, with `condition` from `condition_of`; or with
        `masks` from `metrics.mask_f1`.
    """
    results = list(results)
    scenes = [result for result in results if "objects" in result]
    found: dict[str, Any] = {"scenes": len(results)}
    for threshold in THRESHOLDS:
        key = f"{threshold:g}"
        found[f"f1@{key}"] = _pooled([result["objects"][key] for result in scenes])
    found["edge_f1"] = _pooled([result["edges"] for result in scenes if result["edges"] is not None])
    found["graph_exact"] = _share([result["graph_exact"] for result in scenes])
    found["mask_f1"] = _pooled([result["masks"] for result in results if "masks" in result])
    pairs = [pair for result in scenes for pair in result["pairs"]]
    for key in ("position", "rotation", "add_s"):
        values = [pair[key] for pair in pairs if pair[key] is not None]
        found[f"median_{key}"] = float(np.median(values)) if values else None
    sizes = [np.abs(pair["size"]).max() for pair in pairs]
    found["median_size"] = float(np.median(sizes)) if sizes else None
    conditions = [result["condition"] for result in results if "condition" in result]
    found["floating"] = _share([bool(each["floating"]) for each in conditions])
    found["intersecting"] = _share([bool(each["intersecting"]) for each in conditions])
    found["stable"] = _share([each["stable"] for each in conditions])
    return found


def _pooled(rates: Sequence[Mapping[str, Any]]) -> float | None:
    """Return the F1 of hits, predictions and truths summed over scenes."""
    if not rates:
        return None
    return f1(*(sum(rate[key] for rate in rates) for key in ("hits", "predicted", "truth")))


def _share(flags: Sequence[bool | None]) -> float | None:
    known = [flag for flag in flags if flag is not None]
    return float(np.mean(known)) if known else None
