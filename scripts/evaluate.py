"""Measure inference from bare depth images: make scenes with known truth, infer them, print the table.

    python scripts/evaluate.py                           every set, 40 scenes each
    python scripts/evaluate.py settled tower -n 100      some sets, more scenes
    python scripts/evaluate.py mosd graspnet ycbv        real frames (folder: DERENDER_REAL, else ../shared/real)

Objects with fewer than 100 visible pixels need not be found. Times are of `infer_structure` in this process, after a
first scene that pays for loading the compiled code.
"""

import argparse
import json
import os
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent))

from scene_makers import SETS, make_scene  # noqa: E402

from derender.evaluation.matching import assign  # noqa: E402
from derender.evaluation.metrics import compare_scenes  # noqa: E402
from derender.inference.structure.infer import infer_structure  # noqa: E402
from derender.report.scene_json import scene_json  # noqa: E402

REAL_SETS = ("mosd", "graspnet", "ycbv")
ENOUGH_PIXELS = 100


def real_folder():
    """Return the folder of real frames, or None."""
    folder = Path(os.environ.get("DERENDER_REAL", Path(__file__).resolve().parents[2] / "shared" / "real"))
    return folder if folder.is_dir() else None


def truth_scene(scene):
    """Return the truth of a made scene in the contract's JSON form, and the names of the objects hardly seen."""
    items = [{"name": "floor", "type": "plane", "size": None, "pose": scene["floor"], "parent": "root"}]
    for k, item in enumerate(scene["objects"]):
        parent = "floor" if item["parent"] == "floor" else f"true_{item['parent']}"
        supports = [f"true_{other}" for other in item.get("supports", ())]
        items.append({**item, "name": f"true_{k}", "parent": parent, "supports": supports})
    hidden = [f"true_{k}" for k, item in enumerate(scene["objects"]) if item["pixels"] < ENOUGH_PIXELS]
    return {"objects": items}, hidden


def evaluate_made(name, count, first, options, verbose):
    """Return the table row of a set of made scenes."""
    results, seconds = [], []
    for k in range(first, first + count):
        scene = make_scene(np.random.default_rng([k, SETS.index(name)]), name)
        start = time.perf_counter()
        posterior = infer_structure(scene["depth"], scene["camera"], options, np.random.default_rng(k))
        seconds.append(time.perf_counter() - start)
        truth, hidden = truth_scene(scene)
        results.append(compare_scenes(scene_json(posterior.best_graph()), truth, ignored=hidden))
        if verbose:
            print(name, k, json.dumps({key: results[-1][key] for key in ("objects", "graph_exact", "missed", "extra")}))
    row = {"set": name, "scenes": count}
    for threshold in ("0.5", "0.75", "0.9"):
        counts = [r["objects"][threshold] for r in results]
        hits, said, true = (sum(c[key] for c in counts) for key in ("hits", "predicted", "truth"))
        row[f"F1 @ {threshold}"] = 2 * hits / max(said + true, 1)
    row["graph exact"] = np.mean([r["graph_exact"] for r in results])
    row["seconds"] = np.median(seconds)
    return row


def read_depth(path, scale):
    """Return a 16-bit depth image in metres, NaN = no return."""
    import imageio.v3 as imageio

    depth = imageio.imread(path).astype(float) * scale / 1000
    return np.where(depth > 0, depth, np.nan)


def predicted_labels(graph, depth, camera):
    """Return (H, W) int: 1 + the solid that each pixel with a return shows within 3 cm, 0 for none, and their names."""
    from derender.inference.structure.infer import draw_graph

    drawn, label, names = draw_graph(graph, depth.shape, camera)
    return np.where((label >= 0) & (np.abs(np.nan_to_num(depth) - drawn) < 0.03), label + 1, 0), names


def evaluate_mosd(folder, options, verbose):
    """Return the table row of the 45 Kinect frames: F1 of masks and of support edges."""
    import imageio.v3 as imageio

    camera = json.loads((folder / "mosd/camera.json").read_text())
    graphs = json.loads((folder / "mosd/support_graph.json").read_text())
    hits = said = true = 0
    edges = np.zeros(3)
    seconds = []
    for path in sorted((folder / "mosd/depth").glob("*.png")):
        depth = read_depth(path, camera["depth_scale"])
        start = time.perf_counter()
        graph = infer_structure(depth, camera, options, np.random.default_rng(0)).best_graph()
        seconds.append(time.perf_counter() - start)
        label = imageio.imread(folder / "mosd/label" / path.name) // 10
        predicted, names = predicted_labels(graph, depth, camera)
        ids = [k for k in np.unique(label) if k >= 2]
        overlap = np.array([[np.sum((predicted == j + 1) & (label == k)) / np.sum((predicted == j + 1) | (label == k))
                             for k in ids] for j in range(len(names))]).reshape(len(names), len(ids))  # fmt: skip
        hits, said, true = hits + len(assign(overlap, 0.5)), said + len(names), true + len(ids)
        if path.stem in graphs:
            who = {names[j]: str(ids[k]) for j, k in assign(overlap, 0.25)} | {"floor": "table"}
            told = {(who.get(n, "?"), who.get(graph.vertex(n).parent, "?")) for n in names}
            known = {(child, str(parent)) for child, parent in graphs[path.stem].items()}
            edges += len(told & known), len(told), len(known)
        if verbose:
            print(path.stem, "masks", len(assign(overlap, 0.5)), "of", len(ids), "found", len(names))
    return {"set": "mosd", "scenes": len(seconds), "F1 @ 0.5": 2 * hits / (said + true),
            "graph exact": 2 * edges[0] / (edges[1] + edges[2]), "seconds": np.median(seconds)}  # fmt: skip


def report_sizes(folder, options):
    """Print the sizes found on the graspnet and ycbv frames."""
    frames = [("graspnet", name) for name in ("sugar", "cheezit", "cylinder")] + [("ycbv", "0001_000001")]
    for kind, name in frames:
        camera = json.loads((folder / kind / f"{name}_camera.json").read_text())
        depth = read_depth(folder / kind / f"{name}_depth.png", camera["depth_scale"])
        start = time.perf_counter()
        graph = infer_structure(depth, camera, options, np.random.default_rng(0)).best_graph()
        print(f"{kind} {name}: {time.perf_counter() - start:.2f} s")
        for item in scene_json(graph)["objects"]:
            if item["size"] is not None:
                print(f"  {item['type']:9s} {np.round(1000 * np.sort(item['size']))} mm on {item['parent']}")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sets", nargs="*", help=f"of {', '.join(SETS + REAL_SETS)}; default: all")
    parser.add_argument("-n", type=int, default=40, help="scenes of each made set")
    parser.add_argument("--first", type=int, default=0, help="number of the first scene (its seed)")
    parser.add_argument("--method", default="auto")
    parser.add_argument("--verbose", action="store_true")
    arguments = parser.parse_args()
    unknown = set(arguments.sets) - set(SETS + REAL_SETS)
    if unknown:
        parser.error(f"no such set: {', '.join(sorted(unknown))}")
    options = {"method": arguments.method}
    chosen = arguments.sets or [*SETS, *REAL_SETS]
    warm = make_scene(np.random.default_rng(0), "settled")
    infer_structure(warm["depth"], warm["camera"], options, np.random.default_rng(0))
    print("| set | scenes | F1 @ 0.5 | F1 @ 0.75 | F1 @ 0.9 | graph exact | median seconds |\n" + "|---" * 7 + "|")
    for name in chosen:
        if name in SETS:
            row = evaluate_made(name, arguments.n, arguments.first, options, arguments.verbose)
        elif real_folder() is None:
            print(f"| {name} | no folder of real frames here |")
            continue
        elif name == "mosd":
            row = evaluate_mosd(real_folder(), options, arguments.verbose)
        else:
            continue
        shown = ("F1 @ 0.5", "F1 @ 0.75", "F1 @ 0.9", "graph exact")
        cells = [f"{row[key]:.3f}" if key in row else "" for key in shown]
        print(f"| {name} | {row['scenes']} | {' | '.join(cells)} | {row['seconds']:.2f} |", flush=True)
    if real_folder() is not None and {"graspnet", "ycbv"} & set(chosen):
        report_sizes(real_folder(), options)


if __name__ == "__main__":
    main()
