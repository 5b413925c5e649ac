"""Small pictures as SVG text: the scene graph as a tree, traces and rank plots of chains."""

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np

from derender.results.table import SURE, digits, type_probability, type_text

CHAIN_COLOURS = ("#2166ac", "#d6604d", "#5aae61", "#9970ab", "#bf812d", "#35978f", "#c51b7d", "#4d4d4d")
TRACE_POINTS = 160
RANK_BINS = 20
TRACE_SIZE, RANK_SIZE = (200, 34), (130, 34)  # pixels
CHARACTER, PADDING = 0.58, 8.0  # width of a character in its size, of wide fonts; beside words in a box
MOST_ABREAST = 5  # objects beside each other whose words can be read


def graph_svg(scene: Mapping[str, Any], colours: Mapping[str, str] | None = None) -> str:
    """Return the scene graph as a tree that stands on its root, as the things themselves do; a broad one lies.

    scene : as `derender show --json` prints it; probabilities, where there, are written at their edges.
    colours : of the objects by name, as #rrggbb.
    """
    colours = colours or {}
    objects = {item["name"]: item for item in scene["objects"]}
    column, row, leaves = tree_places(objects)
    deepest = max(row.values())
    lying = leaves > MOST_ABREAST
    width, height = 196, 62
    gap, apart = (44, 10) if lying else (34, 18)
    # Of a box, along the way that the tree grows and across.
    deep, broad = (width, height) if lying else (height, width)
    long, wide = (deepest + 1) * (deep + gap) - gap + 12, max(1, leaves) * (broad + apart) + 10
    total_width, total_height = (long, wide) if lying else (wide, long)

    def at(name: str, along: float = 0.0) -> tuple[float, float]:
        """Return a place so far along the tree from the middle of an object's box: to the right, or upwards."""
        along += row[name] * (deep + gap) + 0.5 * deep + 6
        across = (column[name] + 0.5) * (broad + apart)
        return (along, across) if lying else (across, long - along)

    def line(name: str, parent: str, bend: float, dashes: str = "") -> str:
        """Return the line from a parent's side to that of what it bears."""
        half = 0.5 * deep
        points = at(parent, half), at(parent, half + bend), at(name, -half - bend), at(name, -half)
        begin, *others = (f"{x:.1f} {y:.1f}" for x, y in points)
        return f'<path d="M{begin}C{" ".join(others)}" fill="none" stroke="#9aa0a8" stroke-width="1.6"{dashes}/>'

    parts = []
    for name, item in objects.items():
        parts.append(line(name, item["parent"] if item.get("parent") in objects else "root", 0.5 * gap))
        others = (other for other in item.get("supports", ()) if other in column)
        parts += [line(name, other, 0.0, ' stroke-dasharray="5 4"') for other in others]
    for name in column:
        x, y = at(name)
        shown = objects.get(name)
        fill = colours.get(name, "#cdcbc6")
        if shown is not None and shown.get("size") is not None:
            parts.append(f'<g role="button" tabindex="0" aria-pressed="false" data-object="{escape(name)}">')
        parts.append(
            f'<rect x="{x - 0.5 * width:.1f}" y="{y - 0.5 * height:.1f}" width="{width}" height="{height}" rx="6" '
            f'fill="{fill}" fill-opacity="{0.35 if shown else 0}" stroke="{fill if shown else "#9aa0a8"}" '
            'stroke-width="1.6"/>'
        )
        top = y - 0.5 * height + (19 if shown else 27)  # the root has one line less: it rests on nothing
        parts.append(_text(x, top, name, size=13, weight=600, room=width))
        parts.append(_text(x, top + 17, _node_words(shown), size=11, room=width))
        if shown:
            parts.append(_text(x, top + 34, _edge_words(shown), size=10.5, faint=True, room=width))
        if shown is not None and shown.get("size") is not None:
            parts.append("</g>")
    scale = min(1.0, 720 / total_width)
    picture = _svg(total_width, total_height, parts, "The scene graph", scale, "group")  # with buttons in it
    # in a narrow window it is scrolled before its words get too small to read
    narrowest = f'<svg style="min-width:{0.6 * total_width:.0f}px" '
    return (
        '<div class="scroll" role="region" tabindex="0" aria-label="Scene graph">'
        f'{picture.replace("<svg ", narrowest, 1)}</div><p class="more" hidden>The graph goes on to the right.</p>'
    )


def tree_places(objects: Mapping[str, Mapping[str, Any]]) -> tuple[dict[str, float], dict[str, int], int]:
    """Return where the objects and their root stand in a tree: column by name, row by name, and how many columns."""
    children: dict[str, list[str]] = {"root": []}
    for name, item in objects.items():
        parent = item.get("parent") or "root"
        children.setdefault(parent if parent in objects else "root", []).append(name)
    column: dict[str, float] = {}
    row: dict[str, int] = {}
    leaves = 0

    def place(name: str, level: int) -> None:
        nonlocal leaves
        row[name] = level
        below = children.get(name, [])
        for child in below:
            place(child, level + 1)
        if below:
            column[name] = float(np.mean([column[child] for child in below]))
        else:
            column[name] = leaves
            leaves += 1

    place("root", 0)
    return column, row, leaves


def trace_svg(draws: np.ndarray) -> str:
    """Return the traces of the chains. draws : (chains, draws) float64."""
    width, height = TRACE_SIZE
    finite = draws[np.isfinite(draws)]
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)
    span = high - low or 1.0
    parts = []
    for chain, values in enumerate(draws):
        keep = np.unique(np.linspace(0, len(values) - 1, min(len(values), TRACE_POINTS)).round().astype(int))
        x = 1 + (width - 2) * keep / max(1, len(values) - 1)
        y = 1 + (height - 2) * (1 - (values[keep] - low) / span)
        path = " ".join(f"{a:.0f},{b:.1f}" for a, b in zip(x, y, strict=True) if np.isfinite(b))
        parts.append(f'<polyline points="{path}" fill="none" stroke="{_chain_colour(chain)}" stroke-opacity="0.75"/>')
    return _svg(width, height, parts, "Trace of each chain")


def rank_svg(draws: np.ndarray) -> str:
    """Return the rank plot: how the ranks of each chain's draws among all draws spread. Level lines are good chains.

    draws : (chains, draws) float64.
    """
    width, height = RANK_SIZE
    chains, count = draws.shape
    flat = draws.ravel()
    ranks = np.empty(flat.size)
    ranks[np.argsort(flat, kind="stable")] = np.arange(flat.size)
    bins = max(2, min(RANK_BINS, count // 4))
    expected = count / bins
    parts = [f'<path d="M0 {height / 2}H{width}" stroke="#c5c9ce" stroke-dasharray="3 3"/>']
    for chain, own in enumerate(ranks.reshape(chains, count)):
        found = np.histogram(own, bins=bins, range=(0, flat.size))[0]
        # The expected number is half way up; twice that is the top.
        y = height - 1 - (height - 2) * np.clip(found / expected, 0, 2) / 2
        edges = np.linspace(0, width, bins + 1)
        steps = f"M0 {y[0]:.1f}" + "".join(f"V{b:.1f}H{a:.1f}" for a, b in zip(edges[1:], y, strict=True))
        parts.append(f'<path d="{steps}" fill="none" stroke="{_chain_colour(chain)}" stroke-opacity="0.8"/>')
    return _svg(width, height, parts, "Rank plot of each chain")


def _node_words(item: Mapping[str, Any] | None) -> str:
    if item is None:
        return "frame"
    words = type_text(item["type"], type_probability(item))
    size = item.get("size")
    if size is not None:
        if item["type"] in ("sphere", "cube"):
            size = size[:1]
        elif item["type"] == "cylinder":
            size = [size[0], size[2]]
        words += " " + " × ".join(f"{100 * value:.1f}" for value in size) + " cm"
    if item.get("probability", 1.0) <= SURE:
        words += " · p " + digits(item["probability"])
    return words


def _edge_words(item: Mapping[str, Any]) -> str:
    contact = item.get("contact") or {}
    words = contact.get("type", "")
    if contact.get("child_face"):
        words += f" {contact['child_face']} on {contact.get('parent_face')}"
    share = (item.get("parent_probability") or {}).get(item.get("parent"), 1.0)
    if share <= SURE:
        words += " · p " + digits(share)
    return words


def _chain_colour(chain: int) -> str:
    return CHAIN_COLOURS[chain % len(CHAIN_COLOURS)]


def _text(
    x: float, y: float, words: str, size: float, weight: int = 400, faint: bool = False, room: float = np.inf
) -> str:
    """Return words whose middle is at (x, y), smaller where they would not fit into a room of so many units."""
    size = min(size, np.floor(10.0 * (room - PADDING) / (CHARACTER * max(len(words), 1))) / 10.0)
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="middle" font-size="{size:g}" font-weight="{weight}" '
        f'class="{"faint" if faint else "ink"}">{escape(words)}</text>'
    )


def _svg(width: float, height: float, parts: Sequence[str], title: str, scale: float = 1.0, role: str = "img") -> str:
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height:.0f}" width="{width * scale:.0f}" '
        f'height="{height * scale:.0f}" role="{role}" aria-label="{escape(title)}">{"".join(parts)}</svg>'
    )
