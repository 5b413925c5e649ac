"""report.html: one file, no network, of what was seen, what explains it, and how sure that is."""

from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from derender.report import pictures, svg, tables, viewer
from derender.report.contents import Report
from derender.results import trust
from derender.scene import solids as kinds
from derender.scene.solids import Solids

HERE = Path(__file__).parent
MOST_STRUCTURES = 8  # of the table
# A residual picture's scale: what holds all but 5 % of the residuals, yet no less than 2 mm and no more than 5 cm.
RESIDUAL_SCALE = (0.002, 0.05)


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
    mark = "" if trust.trusted(report.doubts) else ' class="bad"'
    lines = trust.verdict(report.doubts, report.parameters)
    verdict = "".join(f"<p{mark}>{escape(line[0].upper() + line[1:])}.</p>" for line in lines)
    return f'<h1>{escape(report.title)}</h1><p>{words}</p>{verdict}<p class="soft">{facts}</p>'


def _depth_pictures(report: Report) -> str:
    if report.camera is None:
        return ""
    from derender.render.raycast.depth import render_depth

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
    from derender.render.blur import blur

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
        f'<tr><td class="number">{escape(weight)}</td><td>{escape(words)}</td></tr>'
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
