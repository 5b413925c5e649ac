"""report.html: one file, no network, of what was seen, what explains it, and how sure that is."""

from collections.abc import Mapping
from html import escape
from pathlib import Path

import numpy as np

from derender.atomic import write_text
from derender.report import pictures, svg, tables, viewer
from derender.report.contents import Report
from derender.report.pictures import depth_pictures
from derender.results import trust
from derender.results.table import as_page, extents_text, probability_text

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
    off = np.abs(report.observed - report.fit.depth)
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
        words.append(f"P(stable) {told['p_stable']:.2f}")
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
        for weight, words in report.structures[:MOST_STRUCTURES]
    )
    head = '<tr><th class="number">weight</th><th>structure</th></tr>'
    return wide(f'<table class="narrow">{head}{rows}</table>', "structures")


def _objects(report: Report, colours: Mapping[str, str]) -> str:
    rows, drawn = [], _drawn(report)
    for item in report.scene["objects"]:
        name, size = escape(item["name"]), item.get("size")
        extents = "–" if size is None else extents_text(size, item.get("size_interval"))
        likely = "–"
        if drawn and "probability" in item:
            likely = escape(probability_text(item["probability"], item.get("probability_error", 0.0)))
        position = ", ".join(f"{row[3]:.3f}" for row in item["pose"][:3])
        swatch = f'<span class="bar" style="width:12px;background:{colours.get(item["name"], "#cdcbc6")}"></span>'
        shown = f'<button type="button" data-object="{name}" aria-pressed="false">{swatch} {name}</button>'
        rows.append(
            f'<tr data-object="{name}"><td>{shown if size is not None else swatch + " " + name}</td>'
            f"<td>{escape(item['type'])}</td><td class=number>{extents}</td>"
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


def _drawn(report: Report) -> bool:
    """Return whether there is more than one draw: a single scene has no probabilities."""
    return any(row["draws"].size > 1 for row in report.parameters)


def _parameters(report: Report) -> str:
    if not report.parameters:
        return ""
    names = tables.columns(report.parameters)
    head = "".join(f"<th{' class=number' if k else ''}>{name}</th>" for k, name in enumerate(names))
    chains, draws = report.parameters[0]["draws"].shape
    plots = _drawn(report)
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
