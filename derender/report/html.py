"""report.html: one file, no network, of what was seen, what explains it, and how sure that is."""

from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from derender.model import solids as kinds
from derender.model.solids import Solids
from derender.report import pictures, svg, tables, trust, viewer
from derender.vision.camera import Camera

if TYPE_CHECKING:
    from derender.document import LikelihoodPrior
    from derender.inference.posterior import Posterior
    from derender.model.scene import SceneGraph

HERE = Path(__file__).parent
SHOWN_DRAWS = 12
# A residual picture's scale: what holds all but 5 % of the residuals, yet no less than 2 mm and no more than 5 cm.
MOST_STRUCTURES = 8  # of the table
RESIDUAL_SCALE = (0.002, 0.05)


class Report(NamedTuple):
    """What a report shows.

    Attributes
    ----------
    title : the name of the image or scene.
    scene : the most probable scene, as `derender show --json` prints it.
    solids : the solids of that scene; solid_names : their names.
    camera : of the image, or None.
    observed : (height, width) float64, metres, NaN without return, or None.
    draws : solids of some posterior draws, to show the spread.
    parameters : rows of `tables.parameter_rows`, conditional on the most probable structure.
    structures : (weight, words) of each structure found, most probable first.
    facts : what else is known, shown in the head: seed, version, command, the sensor, times.
    doubts : why the posterior is not to be trusted, a line each.
    likelihood : numbers of the likelihood by name; `blur` (pixels) and `background` (metres) make the explained depth
        what Eq. 6 compares with the observed one.
    """

    title: str
    scene: Mapping[str, Any]
    solids: Solids
    solid_names: Sequence[str]
    camera: Camera | None = None
    observed: np.ndarray | None = None
    draws: Sequence[Solids] = ()
    parameters: Sequence[Mapping[str, Any]] = ()
    structures: Sequence[tuple[float, str]] = ()
    facts: Mapping[str, Any] = {}
    likelihood: Mapping[str, Any] = {}
    doubts: tuple[str, ...] = ()


def report_of(
    graph: "SceneGraph",
    camera: Camera | None = None,
    observed: np.ndarray | None = None,
    posterior: "Posterior | None" = None,
    title: str = "derender",
    facts: Mapping[str, Any] | None = None,
    likelihood: Mapping[str, Any] | None = None,
    lost: int = 0,
) -> Report:
    """Gather what a report shows of a scene and, where there is one, of the posterior that it is the best of.

    Parameters
    ----------
    observed : (height, width) float64, metres, NaN without return.
    facts : further entries for the head, such as seconds.
    likelihood : numbers of the likelihood by name, see `Report` and `likelihood_numbers`.
    lost : how many chains died.
    """
    from derender.report.scene_json import scene_json
    from derender.report.structure_words import told_structures

    known: dict[str, Any] = {**sensor_words(likelihood or {}), **dict(facts or {})}
    draws, rows, structures = [], [], []
    if posterior is not None:
        known = {"seed": posterior.seed, "version": posterior.version, "command": posterior.command, **known}
        # Which draws are shown must not change what `infer` wrote with a seed: the picture has its own.
        draws = [drawn.solids() for drawn in posterior.graphs(np.random.default_rng(0), SHOWN_DRAWS)]
        best = posterior.best_part
        periods = dict(zip(best.addresses, best.periods, strict=True)) if best.periods else {}
        rows = tables.parameter_rows(best.addresses, best.values, periods)
        structures = told_structures(posterior)
    return Report(
        title,
        scene_json(graph, posterior),
        graph.solids(),
        graph.solid_names,
        camera,
        observed,
        draws,
        rows,
        structures,
        {key: value for key, value in known.items() if value not in (None, "")},
        dict(likelihood or {}),
        trust.doubts_of(posterior, rows, lost) if posterior is not None else (),
    )


def likelihood_numbers(likelihood: "LikelihoodPrior | None") -> dict[str, float]:
    """Return the numbers of a file's likelihood by name, with defaults for what it leaves out or open; {} for none."""
    from derender.vision.likelihoods import likelihoods

    if likelihood is None:
        return {}
    given = {key: value for key, value in likelihood.values.items() if isinstance(value, int | float)}
    return likelihoods[likelihood.type].complete(given)


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
    if np.isfinite(numbers.get("effective_pixels", np.inf)):
        words["independent pixels"] = f"{numbers['effective_pixels']:.0f}"
    return words


def write_report(path: str | Path, report: Report) -> None:
    """Write report.html, whole or not at all."""
    from derender.atomic import atomic_path

    with atomic_path(path) as temporary:
        temporary.write_text(page(report), encoding="utf-8")


def page(report: Report) -> str:
    """Return the whole page as text."""
    colours = pictures.colours_of(report.solids, report.solid_names)
    named = {name: _hex(colours[i]) for i, name in enumerate(report.solid_names)}
    sections = [
        _head(report),
        _depth_pictures(report),
        '<div class="side"><div><h2>Scene</h2>' + viewer.viewer_html(report, colours) + "</div>",
        "<div><h2>What rests on what</h2>" + svg.graph_svg(report.scene, named) + _structures(report) + "</div></div>",
        _objects(report, named),
        _parameters(report),
    ]
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(report.title)}</title><style>{(HERE / 'page.css').read_text()}</style></head><body>"
        + "".join(sections)
        + "</body></html>\n"
    )


def _head(report: Report) -> str:
    solids = [item for item in report.scene["objects"] if item.get("size") is not None]
    words = f"{len(solids)} object{'s' if len(solids) != 1 else ''}"
    facts = " · ".join(f"{escape(str(key))} {escape(str(value))}" for key, value in report.facts.items())
    mark = ' class="bad"' if report.doubts else ""
    lines = trust.verdict(report.doubts, report.parameters)
    verdict = "".join(f"<p{mark}>{escape(line[0].upper() + line[1:])}.</p>" for line in lines)
    return f'<h1>{escape(report.title)}</h1><p>{words}</p>{verdict}<p class="soft">{facts}</p>'


def _depth_pictures(report: Report) -> str:
    if report.camera is None:
        return ""
    from derender.vision.raycast.depth import render_depth

    explained, label = render_depth(report.solids, report.camera)
    explained = _as_compared(explained, report.likelihood)
    shown = []
    if report.observed is not None:
        low, high = pictures.depth_limits(report.observed, _near_objects(report.solids, label))
        shown.append(_picture("observed depth", report.observed, low, high, "m", pictures.DEPTH_ANCHORS))
    else:
        low, high = pictures.depth_limits(explained, _near_objects(report.solids, label))
    shown.append(_picture("explained depth", explained, low, high, "m", pictures.DEPTH_ANCHORS))
    if report.observed is not None:
        residual = report.observed - explained
        known = np.abs(residual[np.isfinite(residual)])
        scale = float(np.clip(np.percentile(known, 95), *RESIDUAL_SCALE)) if known.size else RESIDUAL_SCALE[0]
        words = (
            f"residual: observed − explained (median |r| {1000 * np.median(known):.1f} mm)"
            if known.size
            else "residual"
        )
        shown.append(_picture(words, 1000 * residual, -1000 * scale, 1000 * scale, "mm", pictures.RESIDUAL_ANCHORS))
    else:
        still = pictures.png_uri(pictures.shade(report.solids, report.camera, report.solid_names))
        shown.append(f'<figure><img src="{still}" alt="the scene"></figure>')
    return '<h2>Depth</h2><div class="pictures">' + "".join(shown) + "</div>"


def _as_compared(depth: np.ndarray, likelihood: Mapping[str, Any]) -> np.ndarray:
    """Return the depth image that the likelihood compares with the observed one: background filled in, blurred."""
    from derender.vision.blur import blur

    background, sigma = likelihood.get("background"), likelihood.get("blur")
    filled = depth if not isinstance(background, float) else np.where(np.isfinite(depth), depth, background)
    return blur(filled, sigma) if isinstance(sigma, float) and np.all(np.isfinite(filled)) else filled


def _near_objects(solids: Solids, label: np.ndarray) -> np.ndarray:
    """Return which pixels show objects rather than planes, (height, width) bool."""
    return np.isin(label, np.flatnonzero(solids.kind != kinds.PLANE))


def _picture(words: str, values: np.ndarray, low: float, high: float, unit: str, anchors: tuple[str, ...]) -> str:
    ramp = ", ".join("#" + colour for colour in anchors)
    form = ".2f" if unit == "m" else "+.1f"
    return (
        f'<figure><img src="{pictures.png_uri(pictures.paint(values, low, high, anchors))}" alt="{escape(words)}">'
        f"<figcaption><span>{escape(words)}</span><span>{low:{form}} "
        f'<span class="bar" style="background:linear-gradient(90deg, {ramp})"></span> {high:{form}} {unit}</span>'
        "</figcaption></figure>"
    )


def _structures(report: Report) -> str:
    if len(report.structures) < 2:
        return ""
    rows = "".join(
        f'<tr><td class="number">{weight:.1%}</td><td>{escape(words)}</td></tr>'
        for weight, words in report.structures[:MOST_STRUCTURES]
    )
    head = '<tr><th class="number">weight</th><th>structure</th></tr>'
    return f'<div class="scroll"><table class="narrow">{head}{rows}</table></div>'


def _objects(report: Report, colours: Mapping[str, str]) -> str:
    rows = []
    for item in report.scene["objects"]:
        size = item.get("size")
        words = " × ".join(f"{100 * value:.1f}" for value in size) if size is not None else "–"
        position = ", ".join(f"{row[3]:.3f}" for row in item["pose"][:3])
        swatch = f'<span class="bar" style="width:12px;background:{colours.get(item["name"], "#cdcbc6")}"></span>'
        rows.append(
            f"<tr><td>{swatch} {escape(item['name'])}</td><td>{escape(item['type'])}</td><td class=number>{words}</td>"
            f"<td class=number>{position}</td><td>{escape(str(item.get('parent') or '–'))}</td>"
            f"<td class=number>{_share(item.get('probability'))}</td></tr>"
        )
    return (
        '<h2>Objects</h2><div class="scroll"><table><tr><th>name</th><th>type</th><th class=number>size, cm</th>'
        "<th class=number>position in the camera's frame, m</th><th>rests on</th><th class=number>probability</th></tr>"
        + "".join(rows)
        + "</table></div>"
    )


def _share(value: float | None) -> str:
    return "–" if value is None else f"{value:.1%}"


def _parameters(report: Report) -> str:
    if not report.parameters:
        return ""
    names = tables.columns(report.parameters)
    head = "".join(f"<th{' class=number' if k else ''}>{name}</th>" for k, name in enumerate(names))
    chains, draws = report.parameters[0]["draws"].shape
    plots = chains * draws > 1
    rows = []
    for row in report.parameters:
        texts = tables.cells(row)
        numbers = "".join(f"<td class=number>{text}</td>" for text in texts[1:])
        mark = ' class="bad"' if trust.doubtful(row) else ""
        shown = f"<td>{svg.trace_svg(row['draws'])}</td><td>{svg.rank_svg(row['draws'])}</td>" if plots else ""
        rows.append(f"<tr><td{mark}>{escape(texts[0])}</td>{numbers}{shown}</tr>")
    if not plots:
        table = f'<table class="narrow"><tr>{head}</tr>{"".join(rows)}</table>'
        return f'<h2>Numbers of the most probable scene</h2><div class="scroll">{table}</div>'
    largest, smallest = trust.limits(chains * draws)
    return (
        f"<h2>Posterior of the most probable structure: {chains} chain{'s' if chains > 1 else ''} of {draws} draws</h2>"
        f'<p class="soft">R-hat above {largest} and effective sample sizes (ESS) below {smallest:.0f} are in red. '
        "In a rank plot level lines are good.</p>"
        f'<div class="scroll"><table><tr>{head}<th>traces</th><th>ranks</th></tr>{"".join(rows)}</table></div>'
    )


def _hex(colour: np.ndarray) -> str:
    return "#" + "".join(f"{int(part):02x}" for part in colour)
