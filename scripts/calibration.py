"""Are the probabilities and intervals that inference states right? Scenes from the default prior, their noise and blur
with them; inference gets the image and the camera. Prints the table, writes the reliability diagram.

    python scripts/calibration.py -n 300 --jobs 2 -o reliability.png
    python scripts/calibration.py -n 60 --keep records.jsonl       goes on where the file ends
    python scripts/calibration.py --pool one.jsonl two.jsonl       the table of what such files hold together
    python scripts/calibration.py -n 60 --quick            of the best scene alone
    python scripts/calibration.py -n 60 --size 64x48 --sigma 0.006 --twice      smaller images, more noise, two seeds

An object is right where it overlaps a true one (one to one) by an IoU of 0.25, as in `derender eval`'s graphs; an edge
where both its ends are right and the true object rests on it. A structure is right as a whole where it has all objects
of the truth that show in the image or carry one that does, and no other, each with its shape and its parent. A part of
an object counts as hidden where its visible pixels leave out more than HIDDEN of its extent at either end.
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
from derender.document import read_prior_document

os.environ.setdefault("OMP_NUM_THREADS", "1")
import numpy as np
from arguments import at_least_one, pixels, read_records, target

from derender.report.scene_json import scene_json
from worlds.made_scenes import drawn_scene

DRAWS = 200  # scenes drawn from each posterior
INSIDE = 0.9  # of the intervals
HIDDEN = 0.15
REPLICATES = 400  # of made truths, from which the error that chance alone leaves is told
SURE = 0.99  # what is stated at least so surely is counted apart
DIFFERENT = 0.1  # total variation between the answers of two seeds from which on they disagree
LEAST = 1e-4  # probability that a truth which no structure found has in the log score
BINS = np.array([0.0, 0.05, 0.2, 0.4, 0.6, 0.8, 0.9, 0.95, 0.99, 1.0])


def one_scene(seed, prior, size=None, sigma=None, twice=False, told=False, quick=False):
    """Return the record of one scene: statements with their truth, intervals with theirs.

    twice : infer again with another seed, and say how far the two answers are apart. told : infer under the prior that
    the scenes come from, not that of bare images. quick : look for the best scene alone, which has no intervals.
    """
    from derender.structures.infer import infer_structure
    from derender.structures.options import Options

    graph, image, label, camera = drawn_scene(seed, prior, size, sigma)
    start = time.perf_counter()
    options = Options(
        prior=read_prior_document(prior).prior if told else None, method="map" if quick else "auto", quick=quick
    )
    posterior = infer_structure(image, camera, options, np.random.default_rng(seed))
    seconds = time.perf_counter() - start
    truth = scene_json(graph)
    found = {item["name"]: (number, item) for number, part in reversed(list(enumerate(posterior.parts)))
             for item in solids(scene_json(part.graph))}  # fmt: skip
    record = {"seed": seed, "seconds": seconds, "truth": len(solids(truth)), "objects": [], "edges": [], "shapes": [],
              "structures": [], "intervals": []}  # fmt: skip
    answer = structures_of(posterior, truth)
    true = true_structure(truth, {graph.solid_names[k] for k in np.unique(label[label >= 0])})
    record["structures"] = [[share, error, key == true] for key, (share, error) in answer.items()]
    record["missed"] = posterior.meta["missed"]
    if twice:
        other = structures_of(infer_structure(image, camera, options, np.random.default_rng([seed, 7])), truth)
        shares = {key: (answer.get(key, (0.0, 0.0)), other.get(key, (0.0, 0.0))) for key in {*answer, *other}}
        record["variation"] = 0.5 * sum(abs(a[0] - b[0]) for a, b in shares.values())
        likeliest = max(answer, key=lambda key: answer[key][0])
        record["covered"] = bool(covers(*shares[likeliest]))
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
        if len(drawn) > DRAWS // 2 and not quick:
            record["intervals"] += intervals(drawn, graph, true, visible_share(graph, true, image, label, camera))
    return record


def structures_of(posterior, truth):
    """Return {structure: (probability, standard error)} of a posterior, its objects called as the true ones are."""
    found = {}
    for part in posterior.parts:
        scene = scene_json(part.best()[0])
        true = matches_of(scene, truth)
        called = {"floor": "floor", **{item["name"]: true.get(item["name"]) or "?" for item in solids(scene)}}
        key = tuple(sorted((called[item["name"]], item["type"], called.get(item["parent"], "root"))
                           for item in solids(scene)))  # fmt: skip
        share, square = found.get(key, (0.0, 0.0))
        found[key] = share + part.weight, float(np.hypot(square, getattr(part, "weight_error", 0.0)))
    return found


def true_structure(truth, seen):
    """Return the true structure in the same form: of what is seen, by name, and what carries it."""
    parents, shown = {item["name"]: item["parent"] for item in solids(truth)}, set()
    for name in seen & set(parents):
        while name in parents:
            shown.add(name)
            name = parents[name]
    return tuple(sorted((item["name"], item["type"], item["parent"])
                        for item in solids(truth) if item["name"] in shown))  # fmt: skip


def covers(one, other):
    """Whether two (probability, standard error) of the same structure agree within two standard errors."""
    return abs(one[0] - other[0]) <= 2.0 * np.hypot(one[1], other[1]) + 0.01


def solids(scene):
    return [item for item in scene["objects"] if item["size"] is not None]


def matches_of(predicted, truth):
    """Return the true solid that each predicted one is, by name."""
    from derender.evaluation.metrics import assign, iou_matrix, solids_of

    left, right = solids_of(predicted), solids_of(truth)
    return {left[i]["name"]: right[j]["name"] for i, j in assign(iou_matrix(left, right), 0.25)}


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

    sizes = np.array([s for _, s in drawn])
    for axis in range(3):
        same = [k for k in range(3) if size[k] == size[axis] and np.mean(sizes[:, k] == sizes[:, axis]) > 0.5]
        # The side of a cube is one number, though a few draws say that it is a box: else one miss was three.
        if axis == same[0]:
            add("size", sizes[:, axis], size[axis], bool(np.all(seen[same] <= 1.0 - HIDDEN)))
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


def told_error(statements):
    """Return words for the expected calibration error, and for that of as many statements which are right as said.

    Few statements leave an error though every probability is right; as if they were independent, which those of one
    scene are not.
    """
    p, rng = np.array([s[0] for s in statements]), np.random.default_rng(0)
    errors = [expected_error(list(zip(p, rng.random(len(p)) < p, strict=True))) for _ in range(REPLICATES)]
    return (f"expected calibration error {expected_error(statements):.4f}, "
            f"{np.mean(errors):.4f} (95 %: {np.quantile(errors, 0.95):.4f}) if all were as said")  # fmt: skip


def rows_of(records):
    """Return lines of the table."""
    lines = []
    for kind in ("objects", "edges", "shapes"):
        said = [s for r in records for s in r[kind]]
        lines.append(
            f"| {kind} | {len(said)} statements | said {np.mean([s[0] for s in said]):.4f}, "
            f"right {np.mean([s[1] for s in said]):.4f} | {told_error(said)} |"
        )
    lines += structure_rows(records)
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


def structure_rows(records):
    """Return the lines about structures as a whole, and about two seeds."""
    stated = [[(share, right) for share, _, right in r["structures"]] for r in records]
    said = [s for each in stated for s in each]
    best = [max(each) for each in stated]
    sure = [right for share, right in best if share >= SURE]
    right = f"right {np.mean(sure):.4f}" if sure else "none"
    score = [np.log(max(sum(share for share, true in each if true), LEAST)) for each in stated]
    lines = [f"| structures | {len(said)} statements | likeliest said {np.mean([b[0] for b in best]):.4f}, "
             f"right {np.mean([b[1] for b in best]):.4f} | {told_error(best)} |",
             f"| structures at P >= {SURE} | {len(sure)} | {right} | |",
             f"| a search that missed it | said {np.mean([r['missed'] for r in records]):.4f}, "
             f"missed {np.mean([not any(right for _, right in each) for each in stated]):.4f} | |",
             f"| log score of the truth | mean {np.mean(score):.3f} nats | not found {np.mean(np.array(score) <= np.log(LEAST)):.3f} | |"]  # fmt: skip  # noqa: E501
    both = [r for r in records if "variation" in r]
    if both:
        apart = np.mean([r["variation"] > DIFFERENT for r in both])
        lines.append(f"| two seeds | {len(both)} scenes | more than {DIFFERENT} apart {apart:.3f} | "
                     f"error covers the other {np.mean([r['covered'] for r in both]):.3f} |")  # fmt: skip
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
    parser.add_argument("-n", type=at_least_one, default=300, help="scenes")
    parser.add_argument("--first", type=int, default=0, help="seed of the first scene")
    parser.add_argument("--prior", default="tabletop", help="built-in prior, or a file")
    parser.add_argument("--size", type=pixels, help="of the images, as 64x48")
    parser.add_argument("--sigma", type=float, help="metres of noise, where it is not the prior's")
    parser.add_argument("--twice", action="store_true", help="infer with a second seed too")
    parser.add_argument("--told", action="store_true", help="infer under the prior that scenes are drawn from")
    parser.add_argument("--quick", action="store_true", help="look for the best scene alone, as infer --quick")
    parser.add_argument("--jobs", type=at_least_one, default=1, help="processes")
    parser.add_argument("--keep", type=target, help="file of records, one line of JSON for each scene")
    parser.add_argument("--pool", type=Path, nargs="+", help="infer nothing: the table of these files of records")
    parser.add_argument("-o", "--output", type=target, help="reliability diagram, PNG")
    arguments = parser.parse_args()
    records = pooled(arguments.pool) if arguments.pool else inferred(arguments)
    print("\n".join(rows_of(records)))
    if arguments.output:
        draw_diagram(records, arguments.output)


def pooled(paths):
    """Return the records that files hold."""
    return [record for path in paths for record in read_records(path)]


def inferred(arguments):
    """Return a record for each scene that is asked for, those that are kept already among them."""
    wanted = range(arguments.first, arguments.first + arguments.n)
    records = []
    if arguments.keep and arguments.keep.exists():
        records = [r for r in pooled([arguments.keep]) if r["seed"] in wanted]
    todo = [seed for seed in wanted if seed not in {r["seed"] for r in records}]
    chosen = arguments.prior, arguments.size, arguments.sigma, arguments.twice, arguments.told, arguments.quick
    with ProcessPoolExecutor(arguments.jobs, mp_context=get_context("spawn")) as pool:
        for record in pool.map(one_scene, todo, *map(repeat, chosen)):
            records.append(record)
            if arguments.keep:
                with arguments.keep.open("a") as file:
                    file.write(json.dumps(record) + "\n")
    return records


if __name__ == "__main__":
    sys.exit(status_of(main))
