"""Are the probabilities and intervals that inference states right? Scenes from the default prior, their noise and blur
with them; inference gets the image and the camera. Prints the table, writes the reliability diagram.

    python scripts/calibration.py -n 300 --jobs 2 -o reliability.png
    python scripts/calibration.py -n 60 --keep records.jsonl       goes on where the file ends

An object is right where it overlaps a true one (one to one) by an IoU of 0.25, as in `derender eval`'s graphs; an edge
where both its ends are right and the true object rests on it. A part of an object counts as hidden where its visible
pixels leave out more than HIDDEN of its extent at either end.
"""

import argparse
import json
import os
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from itertools import repeat
from multiprocessing import get_context
from pathlib import Path

from derender.cli import status_of

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np  # noqa: E402

DRAWS = 200  # scenes drawn from each posterior
INSIDE = 0.9  # of the intervals
HIDDEN = 0.15
BINS = np.array([0.0, 0.05, 0.2, 0.4, 0.6, 0.8, 0.9, 0.95, 0.99, 1.0])


def make_scene(seed, prior):
    """Return (graph, image, label, camera) of one draw from a prior, noise and blur included."""
    from derender import data_path
    from derender.document import read_document
    from derender.render.likelihoods import likelihoods
    from derender.render.raycast.depth import render_depth

    document = read_document(data_path(f"priors/{prior}.yaml"))
    rng = np.random.default_rng([seed, 2026])
    graph = document.prior.sample(rng)
    depth, label = render_depth(graph.solids(), document.camera)
    values = document.likelihood.sample(rng)
    return graph, likelihoods[document.likelihood.type].sample(rng, depth, values), label, document.camera


def one_scene(seed, prior):
    """Return the record of one scene: statements with their truth, intervals with theirs."""
    from derender.report.scene_json import scene_json
    from derender.structures.infer import infer_structure

    graph, image, label, camera = make_scene(seed, prior)
    start = time.perf_counter()
    posterior = infer_structure(image, camera, {}, np.random.default_rng(seed))
    seconds = time.perf_counter() - start
    truth = scene_json(graph)
    found = {item["name"]: (number, item) for number, part in reversed(list(enumerate(posterior.parts)))
             for item in solids(scene_json(part.graph))}  # fmt: skip
    record = {"seed": seed, "seconds": seconds, "truth": len(solids(truth)), "objects": [], "edges": [], "shapes": [],
              "intervals": []}  # fmt: skip
    matches = [matches_of(scene_json(part.graph), truth) for part in posterior.parts]
    parents = {item["name"]: item["parent"] for item in truth["objects"]}
    kinds = {item["name"]: item["type"] for item in truth["objects"]}
    for name, (number, _) in found.items():
        true = matches[number].get(name)
        there = posterior.object_probability(name)
        record["objects"].append([there, true is not None])
        for parent, share in posterior.parent_probability(name).items():
            above = "floor" if parent == "floor" else matches[number].get(parent)
            record["edges"].append([there * share, true is not None and parents[true] == above])
        if true is not None:
            for shape, share in posterior.shape_probability(name).items():
                record["shapes"].append([share, kinds[true] == shape])
    scenes = posterior.graphs(np.random.default_rng([seed, 1]), DRAWS)
    for name, true in matches[posterior.parts.index(posterior.best_part)].items():
        drawn = [pose_and_size(s, name) for s in scenes if name in s.names]
        if len(drawn) > DRAWS // 2:
            record["intervals"] += intervals(drawn, graph, true, visible_share(graph, true, image, label, camera))
    return record


def solids(scene):
    return [item for item in scene["objects"] if item["size"] is not None]


def matches_of(predicted, truth):
    """Return the true solid that each predicted one is, by name."""
    from derender.evaluation.matching import match_solids

    return match_solids(predicted, truth, 0.25)


def pose_and_size(graph, name):
    """Return (pose (4, 4), extents (3,)) of an object."""
    return graph.poses()[name], np.asarray(graph.vertex(name).body.size(), float)


def visible_share(graph, name, image, label, camera):
    """Return (3,) the shares of the extents along the object's axes over which its pixels lie."""
    rows, columns = np.nonzero(label == graph.solid_names.index(name))
    if len(rows) == 0:
        return np.zeros(3)
    from derender.render.raycast.depth import render_depth

    depth, _ = render_depth(graph.solids(), camera)
    z = depth[rows, columns]
    points = np.stack([(columns - camera.cx) / camera.fx * z, (rows - camera.cy) / camera.fy * z, z], axis=1)
    pose, size = pose_and_size(graph, name)
    local = (points - pose[:3, 3]) @ pose[:3, :3] / size
    return np.maximum(1.0 - 2.0 * np.maximum(0.5 - local.max(axis=0), local.min(axis=0) + 0.5), 0.0)


def intervals(drawn, graph, name, seen):
    """Return one entry for each number: kind, whether its interval holds the truth, its rank, its width, hidden or not.

    drawn : (pose, extents) of the object in the draws. The axes of true boxes are named as those of the first draw.
    """
    from derender.evaluation.metrics import relabellings
    from derender.scene.pose import rotation_vector

    pose, size = pose_and_size(graph, name)
    first_pose, first_size = drawn[0]
    ways = relabellings(size)

    def gap(way):
        turn, extents = way
        return (
            np.linalg.norm(rotation_vector(first_pose[:3, :3].T @ pose[:3, :3] @ turn))
            + 2.0 * np.abs(extents - first_size).sum()
        )

    turn, size = min(ways, key=gap)
    seen = np.abs(turn).T @ seen
    true_rotation = pose[:3, :3] @ turn
    whole = bool(np.all(seen > 1.0 - HIDDEN))
    entries = []

    def add(kind, values, true, hidden):
        values = np.asarray(values)
        low, high = np.quantile(values, [0.5 - INSIDE / 2, 0.5 + INSIDE / 2])
        rank = float(np.mean(values < true))
        entries.append([kind, bool(low <= true <= high), rank, float(high - low), hidden])

    for axis in range(3):
        add("size", [s[axis] for _, s in drawn], size[axis], bool(seen[axis] <= 1.0 - HIDDEN))
    # the place along the object's own axes: the one that is hidden is as uncertain as the side is
    for axis in range(3):
        along = true_rotation[:, axis]
        add("position", [p[:3, 3] @ along for p, _ in drawn], pose[:3, 3] @ along, bool(seen[axis] <= 1.0 - HIDDEN))
    up = -graph.down() / np.linalg.norm(graph.down())
    turns = [float(up @ rotation_vector(p[:3, :3] @ true_rotation.T)) for p, _ in drawn]
    add("turn", turns, 0.0, not whole)
    return entries


def expected_error(statements):
    """Return the expected calibration error of (probability, right) pairs: bins' gaps weighted by their numbers."""
    p, right = np.array([s[0] for s in statements]), np.array([s[1] for s in statements], float)
    bins = np.clip(np.digitize(p, BINS[1:-1]), 0, len(BINS) - 2)
    return sum(abs(p[bins == b].mean() - right[bins == b].mean()) * np.mean(bins == b) for b in np.unique(bins))


def rows_of(records):
    """Return lines of the table."""
    lines = []
    for kind in ("objects", "edges", "shapes"):
        said = [s for r in records for s in r[kind]]
        lines.append(
            f"| {kind} | {len(said)} statements | said {np.mean([s[0] for s in said]):.4f}, "
            f"right {np.mean([s[1] for s in said]):.4f} | expected calibration error "
            f"{expected_error(said):.4f} |"
        )
    entries = [e for r in records for e in r["intervals"]]
    for kind in ("size", "position", "turn"):
        for hidden in (False, True):
            some = [e for e in entries if e[0] == kind and e[4] == hidden]
            if some:
                unit, factor = ("deg", 180 / np.pi) if kind == "turn" else ("mm", 1000)
                wide = factor * np.quantile([e[3] for e in some], [0.5, 0.9])
                lines.append(
                    f"| {kind}, {'hidden' if hidden else 'seen'} | {len(some)} intervals | 90 % hold "
                    f"{100 * np.mean([e[1] for e in some]):.1f} % | width median {wide[0]:.2f}, "
                    f"90 % quantile {wide[1]:.2f} {unit} |"
                )
        some = [e for e in entries if e[0] == kind]
        if some:
            lines.append(
                f"| {kind}, all | {len(some)} intervals | 90 % hold {100 * np.mean([e[1] for e in some]):.1f} % | |"
            )
    seconds = [r["seconds"] for r in records]
    lines.append(f"| seconds | median {np.median(seconds):.2f} | 90 % quantile {np.quantile(seconds, 0.9):.2f} | |")
    return lines


def draw_diagram(records, path):
    """Write the reliability diagram and the ranks of the truth as a PNG."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4.6), layout="constrained")
    left.plot([0, 1], [0, 1], color="0.7", lw=1)
    for kind, colour in (("objects", "C0"), ("edges", "C1"), ("shapes", "C2")):
        said = [s for r in records for s in r[kind]]
        p, true = np.array([s[0] for s in said]), np.array([s[1] for s in said], float)
        bins = np.clip(np.digitize(p, BINS[1:-1]), 0, len(BINS) - 2)
        for b in np.unique(bins):
            chosen = bins == b
            n, rate = chosen.sum(), true[chosen].mean()
            spread = np.sqrt((rate * (1 - rate) + 0.25 / n) / n)
            left.errorbar(p[chosen].mean(), rate, yerr=spread, fmt="o", color=colour, ms=3 + 2 * np.log10(n), capsize=2)
        left.plot([], [], "o", color=colour, label=f"{kind}: {len(said)}, error {expected_error(said):.3f}")
    left.set(xlabel="probability stated", ylabel="share that is right", xlim=(-0.03, 1.03), ylim=(-0.03, 1.05))
    left.legend(loc="center", frameon=False)
    edges = np.linspace(0, 1, 11)
    for kind, colour in (("size", "C0"), ("position", "C1"), ("turn", "C2")):
        ranks = [e[2] for r in records for e in r["intervals"] if e[0] == kind]
        if ranks:
            share = np.histogram(ranks, edges)[0] / len(ranks)
            right.stairs(share, edges, color=colour, label=f"{kind}: {len(ranks)}")
    right.axhline(0.1, color="0.7", lw=1)
    right.set(xlabel="rank of the truth among the draws", ylabel="share")
    right.legend(frameon=False)
    figure.suptitle(f"{len(records)} scenes from the default prior")
    figure.savefig(path, dpi=120)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-n", type=int, default=300, help="scenes")
    parser.add_argument("--first", type=int, default=0, help="seed of the first scene")
    parser.add_argument("--prior", default="tabletop", help="built-in prior")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--keep", type=Path, help="file of records, one line of JSON for each scene")
    parser.add_argument("-o", "--output", type=Path, help="reliability diagram, PNG")
    arguments = parser.parse_args()
    wanted = range(arguments.first, arguments.first + arguments.n)
    records = []
    if arguments.keep and arguments.keep.exists():
        records = [json.loads(line) for line in arguments.keep.read_text().splitlines()]
        records = [r for r in records if r["seed"] in wanted]
    todo = [seed for seed in wanted if seed not in {r["seed"] for r in records}]
    with ProcessPoolExecutor(arguments.jobs, mp_context=get_context("spawn")) as pool:
        for record in pool.map(one_scene, todo, repeat(arguments.prior)):
            records.append(record)
            if arguments.keep:
                with arguments.keep.open("a") as file:
                    file.write(json.dumps(record) + "\n")
    print("\n".join(rows_of(records)))
    if arguments.output:
        draw_diagram(records, arguments.output)


if __name__ == "__main__":
    sys.exit(status_of(main))
