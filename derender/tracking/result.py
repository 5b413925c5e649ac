"""What tracking writes: track.npz, track.json, events.jsonl, and report.html with a time line of what rests on what and
the film beside what explains it.
"""

import json
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from derender import __version__
from derender.atomic import files_together
from derender.camera.intrinsics import Camera
from derender.render.raycast.depth import render_depth
from derender.report import pictures
from derender.report.html import wide
from derender.results.table import as_page, digits
from derender.scene.solids import PLANE, Solids
from derender.tracking.events import events_of
from derender.tracking.thing import GONE, HIDDEN, LOST
from derender.tracking.track import Track

FILES = ("track.npz", "track.json", "events.jsonl", "report.html")
DIGITS = 6  # after the point, of what track.json says


def track_json(track: Track) -> dict[str, Any]:
    """Return the track as track.json holds it: one pose and one parent a frame for each object, null where unknown.

    Beside the contract's keys stand `times`, `rate_spread` and `level_spread` (standard deviations of the frame rate's
    logarithm, 0 where it is known, and of gravity's inclination to the floor, radians), `gravity`, `floor` and `views`,
    and of each object `states`, `deviations` (three standard deviations of its centre, metres), `parent_probability`
    and `lost`: the frames in which the tracker says that it does not know where the object is.
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
        "rate_spread": track.rate_spread,
        "level_spread": track.level_spread,
        "gravity": _rounded(track.gravity),
        "floor": None if track.floor is None else _rounded(track.floor, 9),
        "views": _rounded(track.views, 9),
        "objects": objects,
        "parameters": {},
        "notes": track.notes,
        "trusted": track.trusted,
        "doubts": track.doubts,
    }


def _rounded(values: np.ndarray, digits: int = DIGITS) -> list[list[list[float] | float] | float]:
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
            header=np.array(json.dumps({**made, "notes": track.notes, "doubts": track.doubts, "cut": track.cut})),
        )  # fmt: skip
        (temporary / "track.json").write_text(json.dumps({**track_json(track), **made}), encoding="utf-8")
        lines = "".join(json.dumps(event) + "\n" for event in events_of(track))
        (temporary / "events.jsonl").write_text(lines, encoding="utf-8")
        (temporary / "report.html").write_text(page, encoding="utf-8")


PAGE_STYLE, PAGE_SCRIPT = (Path(pictures.__file__).with_name(name) for name in ("page.css", "page.js"))
MOST_PICTURES = 240  # frames shown; of a longer film every so many
FLOOR_COLOUR, AIR_COLOUR, GONE_COLOUR = "#8a8f98", "#f0b429", "#ffffff"
# Pixels of the time line: a row's height, its names' width, its length, and how narrow it is drawn at most.
ROW, LEFT, WIDE, NARROWEST = 26, 110, 960, 640


def report_page(
    track: Track, frames: Sequence[np.ndarray], camera: Camera, events: Sequence[dict[str, Any]], title: str
) -> str:
    """Return the page as text. frames : of the film, (H, W) metres each, as many as the track has."""
    colours = pictures.colours_of(solids_at(track, 0), ["floor", *track.names])[1:]
    named = {name: "#" + bytes(colour.tolist()).hex() for name, colour in zip(track.names, colours, strict=True)}
    seconds = float(track.times[-1] - track.times[0])
    lost = sum(row.count(LOST) for row in track.states)
    words = (
        f"{len(track.names)} thing{'s' if len(track.names) != 1 else ''}, {len(track.times)} frames, {seconds:.2f} s"
    )
    words += f"; lost in {lost} object-frames" if lost else "; nothing lost"
    told = [*(f"not to be trusted: {doubt}" for doubt in track.doubts), *track.notes]
    notes = "".join(f'<p class="bad">{escape(note[0].upper() + note[1:])}.</p>' for note in told)
    inside = (
        f"<h1>{escape(title)}</h1><p>{words}</p>{notes}"
        + _film(track, frames, camera)
        + "<h2>What rests on what</h2>" + _time_line(track, events, named)
        + "<h2>Events</h2>" + _events(events, named)
        + "<h2>Things</h2>" + _things(track, named)
    )  # fmt: skip
    return as_page(title, PAGE_STYLE.read_text() + STYLE, inside, SCRIPT + PAGE_SCRIPT.read_text())


def with_materials(page: str, lines: Sequence[str]) -> str:
    """Return a film's page with what its motion tells of materials and velocities, in lines, at its end."""
    told = wide(f"<pre>{escape(chr(10).join(lines))}</pre>", "materials")
    return page.replace("</main>", f"<h2>What the motion tells</h2>{told}</main>", 1)


def solids_at(track: Track, t: int) -> Solids:
    """Return the floor and all things that are there in a frame; others lie behind the camera."""
    poses = track.poses[t].copy()
    away = ~np.isfinite(poses[:, 0, 0])
    poses[away] = np.eye(4)
    poses[away, 2, 3] = -100.0
    floor = track.floors()[t]
    count = len(poses) + 1
    return Solids(
        np.array([PLANE, *track.kinds], np.int32), np.concatenate([floor[None], poses]),
        np.concatenate([np.zeros((1, 3)), track.sizes[t]]), np.full(count, -1, np.int32),
    )  # fmt: skip


def _film(track: Track, frames: Any, camera: Camera) -> str:
    """Return observed, explained and residual depth with a slider."""
    shown = range(0, len(track.times), max(1, -(-len(track.times) // MOST_PICTURES)))
    solids = solids_at(track, 0)
    _, label = render_depth(solids, camera)
    low, high = pictures.depth_limits(np.asarray(frames[0]), label > 0)
    uris = []
    for t in shown:
        explained, _ = render_depth(solids_at(track, t), camera)
        observed = np.where(np.asarray(frames[t]) > 0, frames[t], np.nan)
        uris.append([
            pictures.painted_uri(observed, low, high),
            pictures.painted_uri(explained, low, high),
            pictures.painted_uri(1e3 * (observed - explained), -20, 20, pictures.RESIDUAL_ANCHORS),
        ])  # fmt: skip
    strips = "".join(
        f'<div class="shot" data-t="{t}" hidden>' + "".join(f'<img src="{uri}" alt="">' for uri in row) + "</div>"
        for t, row in zip(shown, uris, strict=True)
    )
    times = ",".join(f"{track.times[t]:.3f}" for t in shown)
    return (
        '<h2>Film</h2><div class="heads soft"><span>observed</span><span>explained</span>'
        f'<span>observed − explained, ±20 mm</span></div><div id="film" data-times="{times}">{strips}</div>'
        '<p><button id="play">play</button> '
        f'<input type="range" id="at" min="0" max="{len(uris) - 1}" value="0" aria-label="frame"> '
        '<span id="clock" class="soft"></span></p>'
    )


def _time_line(track: Track, events: Any, named: Any) -> str:
    """Return an SVG: a row for each thing, coloured by what it rests on."""
    count, parents = len(track.times), track.parents()
    step = WIDE / max(count, 1)
    height = ROW * len(track.names) + 34
    parts = []
    for k, name in enumerate(track.names):
        top = ROW * k + 4
        parts.append(f'<text class="ink" x="0" y="{top + 15}" font-weight="600">{escape(name)}</text>')
        runs: list[tuple[int, str]] = []  # of frames that look alike: where one begins, and how it looks
        for t in range(count):
            state, parent = track.states[t][k], parents[t][k]
            colour = AIR_COLOUR if parent is None else FLOOR_COLOUR if parent == "floor" else named[parent]
            if state in (LOST, GONE):
                colour = GONE_COLOUR if state == GONE else "#b2182b"
            chances = track.parent_probability[t, k]
            sure = float(np.max(chances)) if np.isfinite(chances).all() else 1.0
            opacity = 0.3 if state == HIDDEN else max(0.25, sure)
            words = escape(f"{name}: {state}, on {parent or 'nothing'} ({sure:.1f})")
            look = f'height="18" fill="{colour}" fill-opacity="{opacity:.1f}"><title>{words}</title>'
            if not runs or runs[-1][1] != look:
                runs.append((t, look))
        for (t, look), end in zip(runs, [*(begin for begin, _ in runs[1:]), count], strict=True):
            parts.append(f'<rect x="{LEFT + t * step:.1f}" y="{top}" width="{(end - t) * step:.1f}" {look}</rect>')
        for event in events:
            if event["object"] == name:
                x = LEFT + (event["frame"] + 0.5) * step
                parts.append(
                    f'<path d="M{x:.1f} {top - 3}l4 5h-8z" class="ink"><title>{escape(event["event"])}, frame '
                    f"{event['frame']}</title></path>"
                )
    for t in range(0, count, max(1, count // 12)):
        parts.append(f'<text x="{LEFT + t * step:.1f}" y="{height - 12}" font-size="11" class="faint">{t}</text>')
    legend = f"on the floor {_swatch(FLOOR_COLOUR)} in the air or a hand {_swatch(AIR_COLOUR)} "
    legend += " ".join(f"on {escape(name)} {_swatch(colour)}" for name, colour in named.items())
    picture = (
        f'<svg style="min-width:{NARROWEST}px" width="{LEFT + WIDE}" height="{height}" font-size="13" '
        f'viewBox="0 0 {LEFT + WIDE} {height}">{"".join(parts)}<line id="now" x1="{LEFT}" x2="{LEFT}" y1="0" '
        f'y2="{height - 24}" stroke="currentColor" data-left="{LEFT}" data-step="{step}"/></svg>'
    )
    return wide(picture, "time line") + f'<p class="soft">{legend}</p>'


def _swatch(colour: str) -> str:
    return f'<span class="bar" style="width:14px;background:{colour}"></span>'


def _events(events: Any, named: Any) -> str:
    if not events:
        return "<p>None.</p>"
    rows = "".join(
        f'<tr><td class="number">{event["frame"]}</td><td class="number">{event["time"]:.3f}</td>'
        f"<td>{_swatch(named.get(event['object'], '#000'))}&nbsp;{escape(event['object'])}</td>"
        f"<td>{escape(event['event'])}</td><td>{escape(_words(event))}</td></tr>"
        for event in events
    )
    head = '<tr><th class="number">frame</th><th class="number">s</th><th>thing</th><th>event</th><th>how</th></tr>'
    return wide(f'<table class="narrow">{head}{rows}</table>', "events")


def _words(event: Any) -> str:
    if "to" in event:
        return f"from {event['from'] or 'nothing'} to {event['to'] or 'nothing'}, p {digits(event['probability'])}"
    return f"{event['speed'][0]:+.2f} to {event['speed'][1]:+.2f} m/s" if "speed" in event else ""


def _things(track: Track, named: dict[str, str]) -> str:
    rows = []
    for k, name in enumerate(track.names):
        deviations = np.sqrt(np.maximum(np.diagonal(track.covariances[:, k, :3, :3], axis1=1, axis2=2), 0)).max(axis=1)
        sure = f"{1e3 * np.nanmedian(deviations):.1f}" if np.isfinite(deviations).any() else ""
        size = " × ".join(f"{1e3 * s:.0f}" for s in track.sizes[-1, k])
        lost = [str(t) for t, row in enumerate(track.states) if row[k] == LOST]
        rows.append(
            f"<tr><td>{_swatch(named[name])}&nbsp;{escape(name)}</td><td>{track.types[k]}</td><td>{size}</td>"
            f'<td class="number">{sure}</td><td>{", ".join(lost) or "never"}</td></tr>'
        )
    head = '<tr><th>thing</th><th>type</th><th>size, mm</th><th class="number">sd of the centre, mm (median)</th>'
    return wide(f'<table class="narrow">{head}<th>lost in frames</th></tr>{"".join(rows)}</table>', "things")


STYLE = """
#film .shot:not([hidden]), .heads { display: grid; grid-template-columns: 1fr 1fr 1fr; gap: 10px; }
#film img { width: 100%; image-rendering: pixelated; border-radius: 3px; } .heads { font-size: 13px; }
#at { width: 60%; vertical-align: middle; }
"""
SCRIPT = """
const shots = [...document.querySelectorAll('.shot')], at = document.getElementById('at');
const times = document.getElementById('film').dataset.times.split(','), now = document.getElementById('now');
function show() {
  shots.forEach((shot, n) => { shot.hidden = n != at.value; });
  const t = +shots[at.value].dataset.t, x = +now.dataset.left + (t + 0.5) * now.dataset.step;
  now.setAttribute('x1', x); now.setAttribute('x2', x);
  document.getElementById('clock').textContent = 'frame ' + t + ', ' + times[at.value] + ' s';
}
at.oninput = show;
let timer = null;
document.getElementById('play').onclick = event => {
  if (timer) { clearInterval(timer); timer = null; event.target.textContent = 'play'; return; }
  event.target.textContent = 'stop';
  timer = setInterval(() => { at.value = (+at.value + 1) % shots.length; show(); }, 100);
};
show();
"""
