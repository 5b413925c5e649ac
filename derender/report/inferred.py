"""The folder that `derender infer` writes: read the image, have it inferred, write what came of it."""

import contextlib
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from derender.atomic import all_or_none, make_folder, write_text
from derender.document import LikelihoodPrior, read_prior_document, write_document
from derender.errors import DerenderError
from derender.inference.posterior import Posterior
from derender.inference.settings import read_settings
from derender.registry import suggest
from derender.vision.depth_file import read_depth, write_depth

WRITTEN = ("scene.yaml", "posterior.npz", "posterior.nc", "observation.npz", "report.html", "summary.json")


@dataclass(frozen=True)
class Outcome:
    """What there is to tell.

    Attributes
    ----------
    folder : with the files. posterior : what is in them.
    rows : of the table, see report.tables.parameter_rows.
    doubts : why the result is not to be trusted, one line each.
    interrupted : by Ctrl-C.
    """

    folder: Path
    posterior: Posterior
    rows: Sequence[Mapping[str, Any]]
    doubts: tuple[str, ...]
    interrupted: bool

    def table(self) -> str:
        """Return the table, and what rests on what, as plain text."""
        from derender.report.html import structure_words
        from derender.report.tables import parameter_table

        lines = [
            f"{part.weight:6.3f}  {structure_words(part.graph)}"
            for part in sorted(self.posterior.parts, key=lambda part: -part.weight)
        ]
        return "\n".join([*lines, *([parameter_table(self.rows)] if self.rows else [])])

    def print_rich(self) -> None:
        """Print the same with colours on a terminal: doubtful rows in red."""
        from rich.console import Console
        from rich.table import Table

        from derender.report.html import structure_words
        from derender.report.tables import COLUMNS, cells, doubtful

        console = Console()
        for part in sorted(self.posterior.parts, key=lambda part: -part.weight):
            console.print(f"{part.weight:.3f}  {structure_words(part.graph)}", highlight=False)
        if self.rows:
            table = Table(*COLUMNS, box=None)
            for column in table.columns[1:]:
                column.justify = "right"
            for row in self.rows:
                table.add_row(*cells(row), style="red" if doubtful(row) else None)
            console.print(table)


def infer_to_folder(
    image: str,
    prior: str | None,
    output: str | None,
    camera: str | None = None,
    depth_scale: float | None = None,
    method: str = "auto",
    gradient: str = "exact",
    shapes: str | None = None,
    max_objects: int | None = None,
    floor: str | None = None,
    known: str | None = None,
    only_known: bool = False,
    chains: int | None = None,
    draws: int | None = None,
    warmup: int | None = None,
    jobs: int = 1,
    resume: bool = False,
    seed: int = 0,
    strict: bool = False,
    command: str = "derender infer",
    progress: Callable[[float, str], None] | None = None,
    say: Callable[[str], None] = lambda line: None,
    warn: Callable[[str], None] = lambda line: None,
) -> Outcome:
    """Infer and write; the arguments are those of the command.

    Raises
    ------
    DerenderError : whatever is wrong with the image, the camera, the prior or the folder.
    """
    started = time.monotonic()
    document = read_prior_document(prior) if prior is not None else None
    seen = read_depth(image, camera, depth_scale)
    if seen.camera_is_guess and document is not None and document.camera is not None:
        if document.camera.shape == seen.depth.shape:
            seen = seen._replace(camera=document.camera, camera_is_guess=False)
    if seen.camera_is_guess:
        say(f"no camera is given: taking {seen.camera.field_of_view:.0f} degrees horizontal field of view")
    if not np.any(np.isfinite(seen.depth) & (seen.depth > 0)):
        raise DerenderError("the image has no pixel with a depth", image, "give an image that shows something")
    folder = make_folder(output or f"{Path(image).stem if image != '-' else 'scene'}_inferred")
    try:
        found = {"shapes": shapes, "max_objects": max_objects, "floor": floor, "known": known, "only_known": only_known}
        if document is not None and has_objects(document):
            for key, value in found.items():
                if value:
                    option = "--" + key.replace("_", "-")
                    remedy = f"leave out {option} or --scene"
                    raise DerenderError(f"{option} is for images without a scene", prior, remedy)
        with all_or_none(*(folder / name for name in WRITTEN)):
            return _infer(folder, document, seen, image, method, gradient, found, chains, draws, warmup, jobs, resume,
                          seed, command, progress, warn, started)  # fmt: skip
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt) and (folder / "checkpoint").exists():
            say(f"the work so far is in {folder / 'checkpoint'}: the same command with --resume goes on")
        with contextlib.suppress(OSError):
            folder.rmdir()  # nothing was written: leave nothing
        raise


def _infer(folder, document, seen, image, method, gradient, found, chains, draws, warmup, jobs, resume, seed,
           command, progress, warn, started) -> Outcome:  # fmt: skip
    """Infer by what is given, and write."""
    interrupted, lost = False, {}
    likelihood = (document.likelihood if document else None) or LikelihoodPrior()
    if document is not None and has_objects(document):
        from derender.inference.scene import infer_scene

        settings = read_settings(document.inference)
        given = {"chains": chains, "draws": draws, "warmup": warmup}
        settings = settings._replace(**{key: value for key, value in given.items() if value is not None})
        result = infer_scene(
            document, seen.depth, seen.camera, settings, method, seed, jobs, folder, resume, progress, command,
            gradient,
        )
        posterior, interrupted, lost = result
    else:
        posterior = _structure(seen, document, method, found, chains, draws, seed, progress)
        likelihood = LikelihoodPrior()
    seconds = time.monotonic() - started
    meta = {
        **posterior.meta,
        "image": str(image),
        "method": method,
        "camera": seen.camera.to_dict(),
        "camera_guessed": seen.camera_is_guess,
        "interrupted": interrupted,
        "lost_chains": sorted(lost),
    }
    posterior = replace(posterior, seed=seed, command=command, meta=meta)
    for number, why in lost.items():
        warn(f"chain {number} was lost: {why.strip().splitlines()[-1]}")
    return _write(folder, posterior, seen, likelihood, lost, interrupted, seconds)


def has_objects(document) -> bool:
    """Return whether the document names its objects."""
    from derender.model.priors.tree import TreePrior

    return isinstance(document.prior, TreePrior)


def _structure(seen, document, method, found, chains, draws, seed, progress) -> Posterior:
    """Infer what there is from the image alone; `found` holds the options that say what is known of it."""
    from derender.inference.structure.image import KINDS
    from derender.inference.structure.infer import infer_structure
    from derender.inference.structure.library import read_library

    chosen = {"method": method, "seed": seed, "floor": found["floor"], "others": not found["only_known"]}
    if found["shapes"]:
        chosen["shapes"] = [name.strip() for name in found["shapes"].split(",")]
        for name in chosen["shapes"]:
            if name not in KINDS:
                raise DerenderError(f"{name!r} is no shape to look for", "--shapes", suggest(name, sorted(KINDS)))
    if found["known"] is not None:
        chosen["known"] = read_library(found["known"])
    elif found["only_known"]:
        raise DerenderError("nothing is known", "--only-known", "give a library with --known FILE")
    for key, value in (("max_objects", found["max_objects"]), ("chains", chains), ("draws", draws)):
        if value is not None:
            chosen[key] = value
    if method in ("mcmc", "smc"):
        from derender.inference.structure.jumps.run import infer_by_jumps

        return infer_by_jumps(seen.depth, seen.camera, chosen, document, np.random.default_rng(seed), progress)
    if document is not None:
        chosen["prior"] = document.prior
    return infer_structure(seen.depth, seen.camera, chosen, np.random.default_rng(seed), progress)


def doubts_of(posterior: Posterior, rows, lost) -> tuple[str, ...]:
    """Return the reasons not to trust a posterior."""
    from derender.report.tables import limits

    doubts = [f"{len(lost)} of the chains died"] if lost else []
    chains, draws, _ = posterior.best_part.values.shape
    if draws < 4:
        return tuple(doubts)
    largest, smallest = limits(chains * draws)
    worst = max(rows, key=lambda row: np.nan_to_num(row["r_hat"]), default=None)
    if worst and worst["r_hat"] > largest:
        doubts.append(f"the chains disagree: R-hat of {worst['address']} is {worst['r_hat']:.3f}")
    least = min(rows, key=lambda row: np.nan_to_num(row["ess_bulk"], nan=np.inf), default=None)
    if least and least["ess_bulk"] < smallest:
        doubts.append(f"{least['address']} has only {least['ess_bulk']:.0f} effective draws")
    return tuple(doubts)


def _write(folder: Path, posterior: Posterior, seen, likelihood, lost, interrupted, seconds: float) -> Outcome:
    from derender.inference.netcdf import write_netcdf
    from derender.report.html import likelihood_numbers, report_of, write_report
    from derender.report.scene_json import scene_json

    graph = posterior.best_graph()
    best = posterior.best_part
    made = {"seed": posterior.seed, "command": posterior.command}
    drawn = {
        address.removeprefix("likelihood."): float(value)
        for address, value in _best_values(best).items()
        if address.startswith("likelihood.")
    }
    write_document(
        folder / "scene.yaml", graph, camera=seen.camera, likelihood=likelihood.with_values(drawn), made=made
    )
    posterior.save(folder / "posterior.npz")
    write_netcdf(folder / "posterior.nc", posterior)
    write_depth(folder / "observation.npz", seen.depth, seen.camera, made)
    numbers = likelihood_numbers(likelihood.with_values(drawn))
    name = Path(str(posterior.meta["image"])).name
    report = report_of(graph, seen.camera, seen.depth, posterior, name, likelihood=numbers)
    write_report(folder / "report.html", report)
    doubts = doubts_of(posterior, report.parameters, lost)
    rows = {
        row["address"]: {key: _number(row[key]) for key in row if key not in ("address", "draws", "unit", "scale")}
        for row in report.parameters
    }
    summary = {
        **made,
        "version": posterior.version,
        "seconds": round(seconds, 3),
        **posterior.meta,
        "trusted": not doubts,
        "doubts": list(doubts),
        "chains": int(best.values.shape[0]),
        "draws": int(best.values.shape[1]),
        "log_density": float(np.max(best.log_density)),
        "structures": [{"weight": part.weight, "objects": list(part.graph.names)} for part in posterior.parts],
        "extras": best.extras,
        "parameters": rows,
        "scene": scene_json(graph, posterior),
    }
    write_text(folder / "summary.json", json.dumps(summary, indent=1, default=str) + "\n")
    return Outcome(folder, posterior, report.parameters, doubts, interrupted)


def _best_values(part) -> dict[str, float]:
    chain, draw = np.unravel_index(np.argmax(part.log_density), part.log_density.shape)
    return dict(zip(part.addresses, part.values[chain, draw], strict=True))


def _number(value: Any) -> float | None:
    """Return a number as JSON can hold it: None for nan and infinity."""
    return float(value) if np.isfinite(value) else None
