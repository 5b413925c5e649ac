"""What a report shows: gathered from a scene, its image and its posterior, before any of it is drawn."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from derender.camera.intrinsics import Camera
from derender.document import LikelihoodPrior
from derender.render.likelihoods import likelihoods
from derender.report import tables
from derender.report.export import glb_bytes
from derender.report.scene_json import scene_json
from derender.report.tree_text import ToldStructure, told_structures
from derender.results import trust
from derender.results.check import check_fit
from derender.results.fit import Fit, fit_of
from derender.results.posterior import Posterior
from derender.results.table import as_csv, rows_of
from derender.scene.graph import SceneGraph
from derender.scene.solids import Solids

SHOWN_DRAWS = 12


class Report(NamedTuple):
    """What a report shows.

    parameters : rows of `tables.parameter_rows`, conditional on the most probable structure.
    structures : the structures found as people are told of them, most probable first.
    likelihood : numbers of the likelihood by name; `blur` (pixels) and `background` (metres) make the explained depth
        what Eq. 6 compares with the observed one.
    """

    title: str  # the name of the image or scene
    scene: Mapping[str, Any]  # the most probable scene, as `derender show --json` prints it
    solids: Solids  # the solids of that scene
    solid_names: Sequence[str]  # their names
    camera: Camera | None = None  # of the image, or None
    observed: np.ndarray | None = None  # (height, width) float64, metres, NaN without return, or None
    draws: Sequence[Solids] = ()  # solids of some posterior draws, to show the spread
    parameters: Sequence[Mapping[str, Any]] = ()
    structures: Sequence[ToldStructure] = ()
    facts: Mapping[str, Any] = {}  # what else is known, shown in the head: seed, version, command, the sensor, times
    likelihood: Mapping[str, Any] = {}
    doubts: tuple[trust.Doubt, ...] = ()  # reasons to doubt the posterior, from its chains and from its image
    fit: Fit | None = None  # how well the scene fits the image, where there is one
    files: Mapping[str, tuple[str, bytes]] = {}  # (media type, bytes) of what can be downloaded from the page, by name
    simulated: Mapping[str, Any] = {}  # what `derender simulate --json` said of the scene, {} where it has not run
    animations: Sequence[str] = ()  # data: URIs of moving pictures of it
    posterior: Posterior | None = None  # what is shown of, and in its `meta` what is to be thought of it


def report_of(
    graph: SceneGraph,
    camera: Camera | None = None,
    observed: np.ndarray | None = None,
    posterior: Posterior | None = None,
    title: str = "derender",
    facts: Mapping[str, Any] | None = None,
    likelihood: Mapping[str, Any] | None = None,
    told: np.ndarray | None = None,
    shown: bool = True,
) -> Report:
    """Gather what a report shows of a scene and, where there is one, of the posterior that it is the best of.

    observed : (height, width) float64, metres, NaN without return.
    facts : further entries for the head, such as seconds.
    likelihood : numbers of the likelihood by name, see `Report` and `likelihood_numbers`.
    told : (height, width) metres, the `explained.npy` of a folder; None: what the posterior holds.
    shown : whether a page is made of it: only that needs draws and downloads.
    """
    known: dict[str, Any] = {**sensor_words(likelihood or {}), **dict(facts or {})}
    draws, rows, structures = [], [], []
    if posterior is not None:
        known = {"seed": posterior.seed, "version": posterior.version, "command": posterior.command, **known}
        # Which draws are shown must not change what `infer` wrote with a seed: the picture has its own.
        draws = [drawn.solids() for drawn in posterior.graphs(np.random.default_rng(0), SHOWN_DRAWS * shown)]
        best = posterior.best_part
        periods = dict(zip(best.addresses, best.periods, strict=True))
        rows = tables.parameter_rows(best.addresses, best.values, periods)
        structures = told_structures(posterior)
    fit, doubts = None, trust.chain_doubts(posterior, rows) if posterior is not None else ()
    if camera is not None and observed is not None:
        if told is None and posterior is not None and posterior.explanation is not None:
            told = posterior.explanation.depth
        meta = {} if posterior is None else posterior.meta
        fit = fit_of(graph, camera, observed, likelihood or {}, told, meta.get("noise", 0.0))
        given = meta.get("faces", 0.0) > 0.0 and not meta.get("camera_guessed")
        seen = meta.get("spots", ()), given, [*meta.get("clutter", ()), *meta.get("cut_short", ())]
        doubts = (*doubts, *check_fit(graph, fit, camera, observed, likelihood or {}, *seen))
    if posterior is not None:
        doubts = trust.with_all_in_doubt(doubts, graph)
        posterior = replace(posterior, meta={**posterior.meta, **trust.judgement(doubts, graph, fit)})
    scene = scene_json(graph, posterior)
    known = {key: value for key, value in known.items() if value not in (None, "")}
    files = downloads(title, graph, scene) if shown else {}
    return Report(title, scene, graph.solids(), graph.solid_names, camera, observed, draws, rows, structures, known,
                  dict(likelihood or {}), doubts, fit, files, posterior=posterior)  # fmt: skip


def downloads(title: str, graph: SceneGraph, scene: Mapping[str, Any]) -> dict[str, tuple[str, bytes]]:
    """Return the files that a page offers: a row for each object as CSV, and the scene as GLB."""
    judged = {"trusted": scene.get("trusted", True), "doubts": scene.get("doubts", ())}
    rows = rows_of(title, {"scene": scene, **judged})
    return {"objects.csv": ("text/csv", as_csv(rows).encode()), "scene.glb": ("model/gltf-binary", glb_bytes(graph))}


def likelihood_numbers(likelihood: LikelihoodPrior | None) -> dict[str, float]:
    """Return the numbers of a file's likelihood by name, with defaults for what it leaves out or open; {} for none."""
    return {} if likelihood is None else likelihoods[likelihood.type].complete(likelihood.fixed)


def sensor_words(numbers: Mapping[str, Any]) -> dict[str, str]:
    """Return what a likelihood's numbers say of the sensor, for a page's head."""
    words = {}
    if "sigma" in numbers:
        growth = numbers.get("sigma_growth", 0.0)
        more = f" + {1000 * growth:.2g} mm/m² z²" if growth else ""
        words["noise"] = f"{1000 * numbers['sigma']:.2g} mm{more}"
    if numbers.get("blur"):
        words["blur"] = f"{numbers['blur']:.2g} pixels"
    if "outlier" in numbers:
        words["outliers"] = f"{numbers['outlier']:.2g} of the pixels"
    if numbers.get("flying"):
        words["flying"] = f"{numbers['flying']:.2g} of the pixels at edges"
    return words
