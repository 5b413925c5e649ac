"""Measure inference where it is hardest: made scenes of many kinds, each with what real cameras and rooms do to them.

    python scripts/frontier.py                        every kind, 12 scenes each
    python scripts/frontier.py stereo free -n 24 -v   some kinds, more scenes, a line for each
    python scripts/frontier.py --help                 what the kinds are

F1 is of solids by their overlap in space (IoU .5, .75), `graph` the share of scenes whose graph is right, `sure, wrong`
that of wrong ones among structures stated at P >= .95 (`-` where none was). `size` is the median error of a size in mm
and, signed, the mean one; `held` the share of sizes in their 90 % intervals. Recall and precision are by silhouettes
(IoU .5); `background` counts solids a scene that show background; `one each` is the share of free-form things that are
one object, `extents` that of their extents within 10 %, `boxes` that of them whose bounding boxes overlap (IoU .5);
`explained` the share of the pixels within 3 cm. With --method map nothing is drawn: no `sure`, no `held`.
"""

import argparse
import sys
import time
from itertools import permutations
from typing import NamedTuple

import numpy as np
from arguments import at_least_one

from derender.cli import status_of
from derender.evaluation.convex import intersection_over_union
from derender.evaluation.metrics import compare_scenes
from derender.report.scene_json import scene_json
from derender.structures.infer import infer_structure
from derender.structures.known.library import Known
from derender.structures.options import Options
from worlds.frontier_scenes import BEHIND, KINDS, SCALE, make

FEWEST = 100  # pixels of an object that is to be found; of small things SMALLEST
SMALLEST = 15
IOU, SURE, EXTENT = 0.5, 0.95, 0.1


class Judged(NamedTuple):
    """Counts of one scene; see the page above for what they are of."""

    true: int
    found: int
    said: int
    behind: int
    things: int
    one_each: int
    extents: tuple
    boxes: tuple
    explained: float
    solid_hits: tuple
    solid_said: int
    solid_true: int
    graph: bool
    sure: bool
    errors: tuple
    held: tuple
    seconds: float


def judge(posterior, scene, fewest, seconds):
    """Return the Judged of a Posterior."""
    told, label = posterior.explanation, scene.label
    objects = [k for k in range(label.max() + 1) if (label == k).sum() >= fewest]
    said = [k for k in range(len(told.names)) if (told.label == k).any()]
    overlap = np.array([[np.sum((told.label == j) & (label == k)) / np.sum((told.label == j) | (label == k))
                         for k in objects] for j in said]).reshape(len(said), len(objects))  # fmt: skip
    found = overlap > IOU
    shows = [np.median(label[told.label == k]) for k in said]
    free = [objects.index(k) for k in scene.free if k in objects]
    one = [bool(found[:, k].any()) for k in free]
    predicted = scene_json(posterior.best_graph(), posterior)
    pairs = [(told.names[said[j]], scene.objects[objects[k]]) for k in free for j in np.flatnonzero(found[:, k])]
    shown = {item["name"]: item for item in predicted["objects"]}
    extents, boxes = extents_of([(shown[name], item) for name, item in pairs])
    free_names = {name for name, _ in pairs}
    predicted["objects"] = [item for item in predicted["objects"] if item["name"] not in free_names]
    solids, hidden = truth_of(scene, objects)
    result = compare_scenes(predicted, solids, ignored=hidden)
    errors, held = sizes_of(result["pairs"], predicted, solids)
    drawn = posterior.best_part.log_density.size > 1
    counts, sure = result["objects"], drawn and posterior.best_part.weight >= SURE
    return Judged(
        len(objects), int(found.any(axis=0).sum()) if said else 0, len(said), sum(x == BEHIND for x in shows),
        len(one), sum(one), extents, boxes, told.share(scene.depth), (counts["0.5"]["hits"], counts["0.75"]["hits"]),
        counts["0.5"]["predicted"], counts["truth"], bool(result["graph_exact"]), sure,
        errors, held if drawn else (), seconds)  # fmt: skip


def extents_of(pairs):
    """Return (whether each extent is within EXTENT, whether boxes overlap by IOU) of pairs (object said, true one)."""
    extents, boxes = [], []
    for said, true in pairs:
        sizes = [[*sorted(item["size"][:2]), item["size"][2]] for item in (said, true)]
        extents += list(np.abs(np.divide(*sizes) - 1.0) < EXTENT)
        boxes.append(intersection_over_union({**said, "type": "box"}, {**true, "type": "box"}) > IOU)
    return tuple(extents), tuple(boxes)


def truth_of(scene, objects):
    """Return (truth as scene JSON, names of solids that need not be found). objects : numbers of those that do."""
    planes = [{"name": name, "type": "plane", "size": None, "pose": pose, "parent": "root"}
              for name, pose in scene.tables.items()]  # fmt: skip
    named = [{**item, "name": f"true_{k}", "parent": item["parent"] if item["parent"] in scene.tables else
              f"true_{item['parent']}", "supports": [f"true_{j}" for j in item["supports"]]}
             for k, item in enumerate(scene.objects) if k not in scene.free]  # fmt: skip
    return {"objects": [*planes, *named]}, [f"true_{k}" for k in range(len(scene.objects)) if k not in objects]


def sizes_of(pairs, predicted, truth):
    """Return (errors of sizes in metres, whether their intervals hold the true ones) of solids of the right type."""
    said = {item["name"]: item for item in predicted["objects"]}
    true = {item["name"]: np.asarray(item["size"]) for item in truth["objects"] if item["size"] is not None}
    errors, held = [], []
    for pair in pairs:
        if not pair["same_type"]:
            continue
        item, size = said[pair["predicted"]], true[pair["truth"]]
        errors += pair["size"]
        orders = [list(order) for order in permutations(range(3))]
        order = min(orders, key=lambda o: np.abs(np.array(item["size"])[o] - size - pair["size"]).sum())
        held += [
            low <= side <= high for (low, high), side in zip(np.array(item["size_interval"])[order], size, strict=True)
        ]
    return tuple(errors), tuple(held)


def row_of(name, judged):
    """Return a kind's row of the table."""
    total = {field: sum(getattr(each, field) for each in judged) for field in ("true", "found", "said", "behind",
             "things", "one_each", "explained", "solid_said", "solid_true", "graph", "sure")}  # fmt: skip
    hits = np.sum([each.solid_hits for each in judged], axis=0)
    errors = 1000.0 * np.array([error for each in judged for error in each.errors])
    wrong = sum(each.sure and not each.graph for each in judged)
    solids = total["solid_said"] + total["solid_true"]
    cells = [*(2 * hits / solids if solids else (1.0, 1.0)), total["graph"] / len(judged),
             ratio(wrong, total["sure"]), np.median(np.abs(errors)) if len(errors) else np.nan,
             np.mean(errors) if len(errors) else np.nan, np.mean([h for each in judged for h in each.held] or [np.nan]),
             ratio(total["found"], total["true"]), ratio(total["found"], total["said"]), total["behind"] / len(judged),
             ratio(total["one_each"], total["things"]),
             *(np.mean([x for each in judged for x in getattr(each, field)] or [np.nan])
               for field in ("extents", "boxes")),
             total["explained"] / len(judged),
             np.median([each.seconds for each in judged])]  # fmt: skip
    return f"| {name} | {len(judged)} | " + " | ".join("-" if np.isnan(x) else f"{x:.2f}" for x in cells) + " |"


def within_scale(scenes, scale):
    """Return the shares of the solids that overlap by .5 and .75 with themselves seen at a wrong scale: the most that
    can be found where one image does not tell it."""
    overlaps = []
    for item in (item for scene in scenes for item in scene.objects):
        pose = item["pose"].copy()
        pose[:3, 3] *= 1.0 + scale
        seen = {"type": item["type"], "pose": pose, "size": (1.0 + scale) * np.asarray(item["size"])}
        overlaps.append(intersection_over_union(seen, item))
    return [np.mean(np.array(overlaps) > least) for least in (0.5, 0.75)]


def known_of(scene):
    """Return the library of the scene's first thing, a box."""
    size = dict(zip(("length", "width", "height"), map(float, scene.objects[0]["size"]), strict=True))
    return (Known("carton", "box", size, {}),)


def ratio(some, all_of_them):
    """Return some / all_of_them, NaN of none."""
    return some / all_of_them if all_of_them else np.nan


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "names",
        nargs="*",
        metavar="KIND",
        help="; ".join(f"{k}: {v.says}" for k, v in KINDS.items()).replace("%", "%%"),
    )
    parser.add_argument("-n", type=at_least_one, default=12, help="scenes of each kind")
    parser.add_argument("--first", type=int, default=0, help="number of the first scene")
    parser.add_argument("--method", default="auto", choices=("auto", "map"))
    parser.add_argument("-v", action="store_true", help="a line for each scene")
    given = parser.parse_args(arguments)
    if unknown := set(given.names) - set(KINDS):
        parser.error(f"no such kind: {', '.join(sorted(unknown))}")
    print("| kind | scenes | F1 .5 | F1 .75 | graph | sure, wrong | size | bias | held | recall | precision | "
          "background | one each | extents | boxes | explained | seconds |\n" + "|---" * 17 + "|")  # fmt: skip
    for name in given.names or KINDS:
        judged, scenes = [], []
        for number in range(given.first, given.first + given.n):
            scene = make(np.random.default_rng([number, list(KINDS).index(name)]), name)
            start = time.perf_counter()
            options = Options(seed=0, method=given.method, known=known_of(scene) if KINDS[name].known else None)
            posterior = infer_structure(scene.depth, scene.camera, options)
            seconds = time.perf_counter() - start
            scenes.append(scene)
            judged.append(judge(posterior, scene, SMALLEST if name == "small" else FEWEST, seconds))
            if given.v:
                print(row_of(f"{name} {number}", judged[-1:]), posterior.explanation.names, flush=True)
        print(row_of(name, judged), flush=True)
        if KINDS[name].sensor == "phone":
            most = "| {:.2f} | {:.2f} |".format(*within_scale(scenes, SCALE))
            print(f"| {name}, the most that its scale leaves | {len(scenes)} {most}", flush=True)


if __name__ == "__main__":
    sys.exit(status_of(main))
