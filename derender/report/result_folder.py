"""The files that `derender infer` leaves in its folder, written together, and what there is to tell of them."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from derender.atomic import files_together, write_bytes, write_text
from derender.camera.depth_file import DepthImage, write_depth
from derender.compilation.threads import run_together
from derender.document import LikelihoodPrior, document_text
from derender.json_text import finite_or_none
from derender.results import trust
from derender.results.posterior import Posterior

SIMULATION = "simulation.json"  # what `derender simulate` found; of an older result it says nothing about a new one
TOGETHER = "report_together.html"  # the page about this result and others: the folder has its own besides
WRITTEN = ("scene.yaml", "posterior.npz", "posterior.nc", "observation.npz", "report.html", "summary.json",
           "labels.png", "explained.npy", SIMULATION, TOGETHER)  # fmt: skip


@dataclass(frozen=True)
class Outcome:
    """What there is to tell."""

    folder: Path  # with the files
    posterior: Posterior  # what is in them
    report: Any  # its Report
    interrupted: bool  # by Ctrl-C
    seconds: float  # that inference took

    @property
    def trusted(self) -> bool:
        """Whether none of the doubts is serious."""
        return trust.trusted(self.report.doubts)

    def structures(self) -> list[str]:
        """Return a line for each structure found that has any weight in two digits: what rests on what."""
        from derender.report.tree_text import hidden_words, told_structures

        told = told_structures(self.posterior)
        wide = max(len(each.text) for each in told)
        lines = [f"p {each.text:{wide}}  {each.words}" for each in told]
        return [*lines, *hidden_words(self.posterior)]

    def lines(self) -> list[tuple[str, bool]]:
        """Return what rests on what, and the table of the unknowns, in lines; and whether a line's row is doubtful."""
        from derender.report.tables import parameter_table

        told = [(line, False) for line in self.structures()]
        if rows := self.report.parameters:
            head, *others = parameter_table(rows).split("\n")
            told += [(head, False), *zip(others, map(trust.doubtful, rows), strict=True)]
        return told

    def verdict(self) -> list[str]:
        """Return whether the result is to be trusted, in lines."""
        return trust.verdict(self.report.doubts, self.report.parameters)

    def details(self) -> str:
        """Return what was found of the sensor, and how long it took, in a line."""
        from derender.report.contents import sensor_words

        told = sensor_words(self.report.likelihood).items()
        return ", ".join([*(f"{name} {words}" for name, words in told), f"{self.seconds:.2f} s"])


def write_results(folder: Path, posterior: Posterior, seen: DepthImage, likelihood: LikelihoodPrior,
                  made: Mapping[str, Any], seconds: float, page: bool = True,
                  timed: bool = True, home: Path | None = None) -> Outcome:  # fmt: skip
    """Write all files of a result, as one set, and return what there is to tell.

    made : seed, command and prior, for scene.yaml. seconds : that inference took.
    page : whether report.html and posterior.nc are among them: `derender report DIR` makes the page later.
    timed : whether summary.json says how long it took. home : as seen from where files are named; None: the folder.
    """
    from derender.camera.image_files import encode_npy, png_bytes
    from derender.report.html import write_report
    from derender.results.predictive import blocks_of, can_be_read, write_netcdf

    report = judged(posterior, seen, likelihood, page)
    posterior = report.posterior
    graph, best = posterior.best_graph(), posterior.best_part
    likelihood = likelihood.with_values(best.likelihood_at(*best.best_place))
    text = document_text(graph, seen.camera, likelihood, made, home or folder)
    report = report._replace(files={"scene.yaml": ("text/yaml", text.encode()), **report.files})
    own = ("address", "draws", "unit", "scale")
    rows = {row["address"]: {key: finite_or_none(float(row[key])) for key in row if key not in own}
            for row in report.parameters}  # fmt: skip
    summary = {
        **made,
        "version": posterior.version,
        **({"seconds": round(seconds, 3)} if timed else {}),
        **posterior.meta,
        "chains": int(best.values.shape[0]),
        "draws": int(best.values.shape[1]),
        "log_density": float(np.max(best.log_density)),
        "structures": [
            {
                "weight": part.weight,
                "weight_error": part.weight_error,
                "weight_interval": list(part.interval),
                "objects": list(part.graph.names),
            }
            for part in posterior.parts
        ],
        "extras": best.extras,
        "parameters": rows,
        "scene": report.scene,
    }
    with files_together(folder, WRITTEN) as place:

        def write_numbers() -> None:
            write_text(place / "scene.yaml", text)
            posterior.save(place / "posterior.npz")
            if page and can_be_read():
                blocks = blocks_of(posterior, seen.depth, seen.camera, np.random.default_rng(posterior.seed))
                write_netcdf(place / "posterior.nc", posterior, blocks)
            if report.fit is not None:
                write_bytes(place / "labels.png", png_bytes(report.fit.label))
                write_bytes(place / "explained.npy", encode_npy(report.fit.depth))
            write_depth(place / "observation.npz", seen.depth, seen.camera, dict(made))
            write_text(place / "summary.json", json.dumps(summary, indent=1, default=str) + "\n")

        if page:
            run_together(partial(write_report, place / "report.html", report), write_numbers)
        else:
            write_numbers()
    return Outcome(folder, posterior, report, bool(posterior.meta["interrupted"]), seconds)


def judged(posterior: Posterior, seen: DepthImage, likelihood: LikelihoodPrior, page: bool = True) -> Any:
    """Return the Report of a posterior, made for a page or not."""
    from derender.report.contents import likelihood_numbers, report_of

    best = posterior.best_part
    numbers = likelihood_numbers(likelihood.with_values(best.likelihood_at(*best.best_place)))
    name = Path(str(posterior.meta.get("image", "image"))).name
    return report_of(posterior.best_graph(), seen.camera, seen.depth, posterior, name, likelihood=numbers, shown=page)
