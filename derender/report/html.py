"""report.html: one file, no network, of what was seen, what explains it, and how sure that is."""

from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from derender.atomic import write_text
from derender.render.blur import blur
from derender.render.likelihoods.pixelwise import noise_at
from derender.render.raycast.depth import render_depth
from derender.report import pictures, svg, tables, viewer
from derender.report.contents import Report
from derender.results import trust
from derender.results.table import as_page, extents_text, probability_text, type_probability, type_text
from derender.results.trust import Region
from derender.scene import solids as kinds

HERE = Path(__file__).parent
MOST_STRUCTURES = 8  # of the table


def write_report(path: str | Path, report: Report) -> None:
    """Write report.html, whole or not at all."""
    write_text(path, page(report))


def page(report: Report) -> str:
    """Return the whole page as text."""
    colours = pictures.colours_of(report.solids, report.solid_names)
    named = {name: "#" + bytes(colours[i]).hex() for i, name in enumerate(report.solid_names)}
    sections = [
        _head(report),
        _downloads(report),
        depth_pictures(report),
        '<div class="side"><div><h2>Scene</h2>' + viewer.viewer_html(report, colours) + "</div>",
        "<div><h2>What rests on what</h2>" + svg.graph_svg(report.scene, named) + _structures(report) + "</div></div>",
        _objects(report, named),
        _parameters(report),
    ]
    return as_page(report.title, (HERE / "page.css").read_text(), "".join(sections), (HERE / "page.js").read_text())


def _head(report: Report) -> str:
    solids = [item for item in report.scene["objects"] if item.get("size") is not None]
    words = f"{len(solids)} object{'s' if len(solids) != 1 else ''}"
    facts = " · ".join(f"{escape(str(key))} {escape(str(value))}" for key, value in report.facts.items())
    mark = "good" if trust.trusted(report.doubts) else "bad"
    lines = trust.verdict(report.doubts, report.parameters)
    verdict = "".join(
        f'<p class="{"note" if line.startswith("worth") else mark}">{escape(line[0].upper() + line[1:])}.</p>'
        for line in lines
    )
    return (f"<h1>{escape(report.title)}</h1><p>{words}</p>{verdict}{_misfit(report)}{_simulated(report)}"
            f'<p class="soft">{facts}</p>')  # fmt: skip


def _misfit(report: Report) -> str:
    """Return how well the scene fits the image, in a line: it stands beside the verdict."""
    if report.fit is None or report.observed is None:
        return ""
    off = np.abs(report.observed - explained_depth(report, report.fit.predicted))
    off = off[np.isfinite(off)]
    median = f", median misfit {1000 * np.median(off):.1f} mm" if off.size else ""
    noise = f" (flat patches show a noise of {1000 * report.fit.noise.sigma:.1f} mm)" if median else ""
    return f"<p>{100 * report.fit.share:.1f} % of the image is explained{median}{noise}.</p>"


def _simulated(report: Report) -> str:
    """Return what a simulation said, where there is one."""
    told = report.simulated
    if not told:
        return ""
    words = [f"Simulated: {told['verdict']}"] if told.get("verdict") else ["Simulated"]
    if isinstance(told.get("p_stable"), int | float):
        from derender.physics.outcome import told_of_missed  # only where it was simulated: physics takes a while

        missed = told_of_missed(told)
        error = told.get("p_stable_error")
        drawn = f" ± {error:.3f}" if isinstance(error, int | float) and error else ""  # as on the terminal
        words.append(f"P(stable) {told['p_stable']:.3f}{drawn}" + (f" ({missed})" if missed else ""))
    moving = "".join(f'<figure><img src="{uri}" alt="the scene as it moves"></figure>' for uri in report.animations)
    how = f' <span class="soft">{escape(told["command"])}</span>' if isinstance(told.get("command"), str) else ""
    return f"<p>{escape(', '.join(words))}.{how}</p>" + (f'<div class="pictures">{moving}</div>' if moving else "")


def _downloads(report: Report) -> str:
    if not report.files:
        return ""
    uris = {escape(name): pictures.data_uri(kind, data) for name, (kind, data) in report.files.items()}
    links = ", ".join(f'<a download="{name}" href="{uri}">{name}</a>' for name, uri in uris.items())
    return f'<p class="files">Download {links}</p>'


def _structures(report: Report) -> str:
    if len(report.structures) < 2:
        return ""
    rows = "".join(
        f'<tr><td class="number">{escape(weight)}</td><td>{escape(words)}</td></tr>'
        for _, weight, words in report.structures[:MOST_STRUCTURES]
    )
    head = '<tr><th class="number">probability</th><th>structure</th></tr>'
    return wide(f'<table class="narrow">{head}{rows}</table>', "structures")


def _objects(report: Report, colours: Mapping[str, str]) -> str:
    rows = []
    for item in report.scene["objects"]:
        name, size = escape(item["name"]), item.get("size")
        extents = "–" if size is None else extents_text(size, item.get("size_interval"))
        likely = "–"
        if "probability" in item:
            likely = escape(probability_text(item["probability"], item.get("probability_error", 0.0)))
        position = ", ".join(f"{row[3]:.3f}" for row in item["pose"][:3])
        swatch = f'<span class="bar" style="width:12px;background:{colours.get(item["name"], "#cdcbc6")}"></span>'
        shown = f'<button type="button" data-object="{name}" aria-pressed="false">{swatch} {name}</button>'
        rows.append(
            f'<tr data-object="{name}"><td>{shown if size is not None else swatch + " " + name}</td>'
            f"<td>{escape(type_text(item['type'], type_probability(item)))}</td><td class=number>{extents}</td>"
            f"<td class=number>{position}</td><td>{escape(str(item.get('parent') or '–'))}</td>"
            f"<td class=number>{likely}</td></tr>"
        )
    head = (
        "<tr><th>name</th><th>type</th><th class=number>size, cm (± half of the 90 % range)</th>"
        "<th class=number>position in the camera's frame, m</th><th>rests on</th><th class=number>probability</th></tr>"
    )
    return "<h2>Objects</h2>" + wide(f"<table>{head}{''.join(rows)}</table>", "objects")


def wide(inside: str, words: str) -> str:
    """Return what may be wider than the window: it then says that it goes on, and scrolls by keys too."""
    return (f'<div class="scroll" role="region" tabindex="0" aria-label="{words}">{inside}</div>'
            '<p class="more" hidden>This goes on to the right.</p>')  # fmt: skip


def _parameters(report: Report) -> str:
    if not report.parameters:
        return ""
    names = tables.columns(report.parameters)
    head = "".join(f"<th{' class=number' if k else ''}>{name}</th>" for k, name in enumerate(names))
    chains, draws = report.parameters[0]["draws"].shape
    plots = any(row["draws"].size > 1 for row in report.parameters)
    rows = []
    for row in report.parameters:
        texts = tables.cells(row)
        numbers = "".join(f"<td class=number>{text}</td>" for text in texts[1:])
        mark = ' class="bad"' if trust.doubtful(row) else ""
        shown = f"<td>{svg.trace_svg(row['draws'])}</td><td>{svg.rank_svg(row['draws'])}</td>" if plots else ""
        rows.append(f"<tr><td{mark}>{escape(texts[0])}</td>{numbers}{shown}</tr>")
    if not plots:
        table = f'<table class="narrow"><tr>{head}</tr>{"".join(rows)}</table>'
        return "<h2>Numbers of the most probable scene</h2>" + wide(table, "numbers")
    largest, smallest = trust.limits(chains * draws)
    return (
        f"<h2>Posterior of the most probable structure: {chains} chain{'s' if chains > 1 else ''} of {draws} draws</h2>"
        f'<p class="soft">R-hat above {largest} and effective sample sizes (ESS) below {smallest:.0f} are in red. '
        "In a rank plot level lines are good.</p>"
        + wide(f"<table><tr>{head}<th>traces</th><th>ranks</th></tr>{''.join(rows)}</table>", "numbers")
    )


# A residual picture's scale: what holds all but 5 % of the residuals, yet no less than 2 mm and no more than 5 cm.
RESIDUAL_SCALE = (0.002, 0.05)
PREDICTED = 320  # columns of the pictures of the posterior predictive, at most
SURPRISE = 4.0  # standard deviations at the ends of that picture's scale


def depth_pictures(report: Report) -> str:
    """Return the pictures of a report's image and of what explains it, as HTML; none without a camera."""
    if report.camera is None:
        return ""
    clean, label = render_depth(report.solids, report.camera)
    explained = explained_depth(report, clean)
    objects = [(name, label == index) for index, name in enumerate(report.solid_names)
               if report.solids.kind[index] != kinds.PLANE]  # fmt: skip
    near = np.isin(label, np.flatnonzero(report.solids.kind != kinds.PLANE))
    if report.observed is None:
        low, high = pictures.depth_limits(explained, near)
        still = pictures.png_uri(pictures.shade(report.solids, report.camera, report.solid_names))
        marks = pictures.marks_svg(report.camera.shape, objects)
        scene = f'<figure><div class="layers"><img src="{still}" alt="the scene">{marks}</div></figure>'
        return side_by_side("Depth", picture("explained depth", explained, low, high, "m", marks), scene)
    low, high = pictures.depth_limits(report.observed, near)
    regions: list[Region] = [region for doubt in report.doubts for region in doubt.regions]
    middle = report.observed[near & np.isfinite(report.observed)]
    middle = middle if middle.size else report.observed[np.isfinite(report.observed)]
    bar = pictures.scale_bar(report.camera, float(np.median(middle))) if middle.size else ""
    marks = pictures.marks_svg(report.camera.shape, objects, regions, bar)
    plain, doubtful = (pictures.marks_svg(report.camera.shape, objects, told) for told in ((), regions))
    residual = report.observed - explained
    known = np.abs(residual[np.isfinite(residual)])
    scale = float(np.clip(np.percentile(known, 95), *RESIDUAL_SCALE)) if known.size else RESIDUAL_SCALE[0]
    words = "residual: observed − explained"
    words += f" (median |r| {1000 * np.median(known):.1f} mm)" if known.size else ""
    ends = -1000 * scale, 1000 * scale
    return side_by_side(
        "Depth",
        picture("observed depth", report.observed, low, high, "m", marks),
        picture("explained depth", explained, low, high, "m", plain),
        picture(words, 1000 * residual, *ends, "mm", doubtful),
    ) + _predictive(report, report.observed)


def explained_depth(report: Report, clean: np.ndarray) -> np.ndarray:
    """Return the depth (H, W) that the best scene explains, NaN where nothing does or background was taken as seen.

    clean : (H, W) metres, of its solids, which tells it where nothing is known of how well they fit.
    """
    if report.fit is not None:
        return np.where(report.fit.background, np.nan, report.fit.depth)
    return as_compared(clean, report.likelihood)


def side_by_side(title: str, *figures: str) -> str:
    """Return figures beside each other under a title."""
    return f'<h2>{title}</h2><div class="pictures">{"".join(figures)}</div>'


def as_compared(depth: np.ndarray, likelihood: Mapping[str, Any]) -> np.ndarray:
    """Return the depth image that the likelihood compares with the observed one: background filled in, blurred."""
    background, sigma = likelihood.get("background"), likelihood.get("blur")
    filled = depth if not isinstance(background, float) else np.fmin(depth, background)
    return blur(filled, sigma) if isinstance(sigma, float) and np.all(np.isfinite(filled)) else filled


def _predictive(report: Report, observed: np.ndarray) -> str:
    """Return pictures of the posterior predictive: how far its draws scatter, and how surprising the image is."""
    camera = report.camera
    if len(report.draws) < 2 or camera is None or all(row["draws"].size == 1 for row in report.parameters):
        return ""
    step = max(1, -(-camera.width // PREDICTED))
    some = np.s_[::step, ::step]  # after the blur: pixels of a smaller camera would not mix with their neighbours
    seen = observed[some]
    drawn = np.array([as_compared(render_depth(each, camera)[0], report.likelihood)[some] for each in report.draws])
    mean, spread = drawn.mean(axis=0), drawn.std(axis=0, ddof=1)
    noise = noise_at(mean, {"sigma": 0.0, **report.likelihood})
    with np.errstate(invalid="ignore", divide="ignore"):
        surprise = (seen - mean) / np.hypot(spread, noise)
    widest = np.nanpercentile(spread, 90) if np.isfinite(spread).any() else 0.0
    widest = float(np.clip(widest, 5e-4, 0.05))
    words = f"surprise: (observed − predicted) / sd, of {len(report.draws)} draws and the noise"
    return side_by_side(
        "What the posterior predicts",
        picture("spread of the posterior's draws (sd)", 1000 * spread, 0.0, 1000 * widest, "mm"),
        picture(words, surprise, -SURPRISE, SURPRISE, "sd"),
    )


def picture(words: str, values: np.ndarray, low: float, high: float, unit: str, marks: str = "") -> str:
    """Return a figure of values (H, W) with its scale, and marks over it."""
    anchors = pictures.RESIDUAL_ANCHORS if low < 0.0 else pictures.DEPTH_ANCHORS
    ramp = ", ".join("#" + colour for colour in anchors)
    form = ".2f" if unit == "m" else "+.1f" if low < 0.0 else ".1f"
    return (
        f'<figure><div class="layers"><img src="{pictures.painted_uri(values, low, high, anchors)}" '
        f'alt="{escape(words)}">{marks}</div><figcaption><span>{escape(words)}</span><span>{low:{form}} '
        f'<span class="bar" style="background:linear-gradient(90deg, {ramp})"></span> {high:{form}} {unit}</span>'
        "</figcaption></figure>"
    )
