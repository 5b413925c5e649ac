"""What tracking writes: track.npz, track.json, events.jsonl and report.html, and how track.npz is read again."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from derender import __version__
from derender.atomic import files_together
from derender.errors import DerenderError
from derender.tracking.events import events_of
from derender.tracking.thing import LOST
from derender.tracking.track import Track

FILES = ("track.npz", "track.json", "events.jsonl", "report.html")
DIGITS = 6  # after the point, of what track.json says


def track_json(track: Track) -> dict[str, Any]:
    """Return the track as track.json holds it: one pose and one parent a frame for each object, null where unknown.

    Beside the contract's keys stand `times`, `gravity`, `floor` and `views`, and of each object `states`, `deviations`
    (three standard deviations of its centre, metres), `parent_probability` and `lost`: the frames in which the tracker
    says that it does not know where the object is.
    """
    parents, words = track.parents(), ["none", "floor", *track.names]
    objects = []
    for k, name in enumerate(track.names):
        there = np.isfinite(track.poses[:, k, 0, 0])
        chances = track.parent_probability[:, k]
        objects.append(
            {
                "name": name,
                "type": track.types[k],
                "size": _rounded(track.sizes[-1, k]),
                "poses": [
                    _rounded(pose, 9) if seen else None for pose, seen in zip(track.poses[:, k], there, strict=True)
                ],
                "parents": [row[k] for row in parents],
                "states": [row[k] for row in track.states],
                "deviations": [
                    _rounded(np.sqrt(np.diag(c)[:3])) if seen else None
                    for c, seen in zip(track.covariances[:, k], there, strict=True)
                ],
                "parent_probability": [
                    {word: round(float(p), 4) for word, p in zip(words, row, strict=True) if p >= 5e-4}
                    if np.isfinite(row).all() else None
                    for row in chances
                ],
                "lost": [t for t, row in enumerate(track.states) if row[k] == LOST],
            }
        )  # fmt: skip
    return {
        "frame": "camera",
        "times": _rounded(track.times, 9),
        "gravity": _rounded(track.gravity),
        "floor": None if track.floor is None else _rounded(track.floor, 9),
        "views": _rounded(track.views, 9),
        "objects": objects,
        "parameters": {},
        "notes": track.notes,
    }


def _rounded(values, digits=DIGITS):
    return np.round(np.asarray(values, float), digits).tolist()


def write_track(folder: Path, track: Track, page: str, made: dict[str, Any]) -> None:
    """Write the four files into a folder, all or none.

    page : the report. made : seed and command, kept with the version.
    """
    made = {"version": __version__, **made}
    with files_together(folder, FILES) as temporary:
        np.savez_compressed(
            temporary / "track.npz",
            names=np.array(track.names, str), types=np.array(track.types, str), kinds=track.kinds,
            times=track.times, frames=np.array(track.frames, str), sizes=track.sizes, poses=track.poses,
            covariances=track.covariances, states=np.array(track.states, str).reshape(len(track.times), -1),
            parents=np.array([[parent or "" for parent in row] for row in track.parents()], str),
            parent_names=np.array(["", "floor", *track.names], str), parent_probability=track.parent_probability,
            views=track.views, floor=np.full((4, 4), np.nan) if track.floor is None else track.floor,
            gravity=track.gravity, rounds=track.rounds, pixels=track.pixels,
            header=np.array(json.dumps({**made, "notes": track.notes, "cut": track.cut})),
        )  # fmt: skip
        (temporary / "track.json").write_text(json.dumps({**track_json(track), **made}), encoding="utf-8")
        lines = "".join(json.dumps(event) + "\n" for event in events_of(track))
        (temporary / "events.jsonl").write_text(lines, encoding="utf-8")
        (temporary / "report.html").write_text(page, encoding="utf-8")


def read_track(path: str | Path) -> Track:
    """Read a track.npz, or that of a folder. DerenderError: no such file, or not one of ours."""
    path = Path(path)
    path = path / "track.npz" if path.is_dir() else path
    try:
        with np.load(path, allow_pickle=False) as file:
            header = json.loads(str(file["header"]))
            floor = file["floor"]
            return Track(
                file["names"].tolist(), file["types"].tolist(), file["kinds"], file["times"], file["frames"].tolist(),
                file["sizes"], file["poses"], file["covariances"], file["states"].tolist(),
                file["parent_probability"], file["views"], None if np.isnan(floor).any() else floor, file["gravity"],
                file["rounds"], file["pixels"], header["notes"], header["cut"],
            )  # fmt: skip
    except FileNotFoundError:
        remedy = "derender infer FRAMES --track -o DIR writes one"
        raise DerenderError("there is no track here", path, remedy) from None
    except (OSError, ValueError, KeyError, EOFError) as fault:
        raise DerenderError("not a track written by derender", path, "give a DIR made with --track") from fault
