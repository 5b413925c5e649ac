"""Measure inference from bare depth images: make scenes with known truth, infer them, print the table.

    python scripts/evaluate.py                           every set, 40 scenes each
    python scripts/evaluate.py settled tower -n 100      some sets, more scenes
    python scripts/evaluate.py mosd graspnet ycbv        real frames (folder: DERENDER_REAL, else ../shared/real)
    python scripts/evaluate.py frames                    labelled real frames and variants (see evaluate_frames.py)
    python scripts/evaluate.py floors                    of the same, whether the floor is found (the same file)
    python scripts/evaluate.py whitening                 noise of real frames, whitened (see evaluate_whitening.py)
    python scripts/evaluate.py tracking -n 6             films: six of each kind (see tracking_figures.py)
    python scripts/evaluate.py trust -n 100              how many answers end trusted (see evaluate_trust.py)
    python scripts/evaluate.py dynamics -n 5             friction, restitution, mass ratios (see dynamics_figures.py)
    python scripts/evaluate.py prediction -n 4           what comes next in a film (see evaluate_prediction.py)
    python scripts/evaluate.py tosses -n 20              where real tosses come to rest (the same file)
    python scripts/evaluate.py physics -n 200            verdicts, margins, bounces and pushes (see evaluate_physics.py)
    python scripts/evaluate.py verdicts -n 200           does it stand? of images (see evaluate_stability.py)
    python scripts/evaluate.py stands -n 40              what --assume-stable tells of where things are (the same)
    python scripts/evaluate.py views -n 20               what a second look tells of towers (see evaluate_views.py)
    python scripts/evaluate.py peers -n 20               sizes beside what plainer tools measure (see evaluate_peers.py)

Objects with fewer than 100 visible pixels need not be found. Times are of `infer_structure` in this process, after a
first scene that pays for loading the compiled code.
"""

import argparse
import importlib
import json
import sys
import time

import numpy as np
from arguments import at_least_one, pixels
from real_frames import evaluate_mosd, real_folder, report_sizes

from derender.cli import status_of
from derender.evaluation.metrics import compare_scenes
from derender.report.scene_json import scene_json
from derender.sampling.chains import SCENES, stream
from derender.structures.infer import infer_structure
from derender.structures.options import Options
from worlds.made_scenes import SETS, make_scene

REAL_SETS = ("mosd", "graspnet", "ycbv")
ENOUGH_PIXELS = 100


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
        scene = make_scene(stream(k, SCENES, SETS.index(name)), name)
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


def evaluators(given):
    """Return what measures each set that has a script of its own, by name, to be imported when it is asked for."""
    films = given.n, given.first, given.sensor
    options, verbose = Options(method=given.method), given.verbose
    seen = given.motion, given.size, given.fps

    def of(module, function, *arguments):
        return lambda: getattr(importlib.import_module(module), f"evaluate_{function}")(*arguments)

    return {
        "frames": of("evaluate_frames", "frames", given.only, given.kinds, given.keep, given.method, verbose),
        "floors": of("evaluate_frames", "floors", given.only, given.kinds, verbose),
        "whitening": of("evaluate_whitening", "whitening", given.only),
        "tracking": of("tracking_figures", "tracking", *films, given.kinds, verbose, *seen),
        "trust": of("evaluate_trust", "trust", given.n, given.first, verbose),
        "dynamics": of("dynamics_figures", "dynamics", *films, given.kinds, given.keep, verbose),
        "prediction": of("evaluate_prediction", "prediction", *films, given.kinds, given.keep),
        "tosses": of("evaluate_prediction", "tosses", given.n, given.first, given.keep),
        "physics": of("evaluate_physics", "physics", given.n),
        "verdicts": of("evaluate_stability", "verdicts", given.n, given.first, options),
        "stands": of("evaluate_stability", "stands", given.n, given.first, options),
        "views": of("evaluate_views", "views", given.n, given.first, verbose),
        "peers": of("evaluate_peers", "peers", given.n, given.first, options),
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sets", nargs="*", help=f"of {', '.join(SETS + REAL_SETS)}; default: all")
    parser.add_argument("-n", type=at_least_one, default=40, help="scenes of each made set")
    parser.add_argument("--first", type=int, default=0, help="number of the first scene (its seed)")
    parser.add_argument("--seeds", type=at_least_one, default=1, help="with which each frame of mosd is inferred")
    parser.add_argument("--method", default="auto")
    parser.add_argument("--verbose", action="store_true")
    parser.add_argument("--sensor", default="kinect", help="of films")
    parser.add_argument("--motion", type=float, default=0.0, help="metres a second that the camera of films moves")
    parser.add_argument("--size", type=pixels, default=(160, 120), help="of the frames of tracked films, pixels")
    parser.add_argument("--fps", type=float, help="of tracked films; default: 24 to 60, by kind")
    parser.add_argument("--kinds", default="", help="of films or variants, such as place,topple; default: all")
    parser.add_argument("--keep", default="", help="folder of results of films or frames that are not done again")
    parser.add_argument("--only", default="", help="of labelled frames, such as ycbv_0,tum_desk_1; default: all")
    arguments = parser.parse_args()
    alone = evaluators(arguments)
    if len(arguments.sets) == 1 and arguments.sets[0] in alone:
        alone[arguments.sets[0]]()
        return
    unknown = set(arguments.sets) - set(SETS + REAL_SETS)
    if unknown:
        parser.error(f"no such set: {', '.join(sorted(unknown))}")
    options = Options(method=arguments.method)
    chosen = arguments.sets or [*SETS, *REAL_SETS]
    warm = make_scene(np.random.default_rng(0), "settled")
    infer_structure(warm["depth"], warm["camera"], options, np.random.default_rng(0))
    print("| set | scenes | F1 @ 0.5 | F1 @ 0.75 | F1 @ 0.9 | graph exact | median seconds |\n" + "|---" * 7 + "|")
    errors = ""
    for name in chosen:
        if name in SETS:
            row = evaluate_made(name, arguments.n, arguments.first, options, arguments.verbose)
        elif real_folder() is None:
            print(f"| {name} | no folder of real frames here |")
            continue
        elif name == "mosd":
            row, errors = evaluate_mosd(real_folder(), options, arguments.seeds, arguments.verbose)
        else:
            continue
        shown = ("F1 @ 0.5", "F1 @ 0.75", "F1 @ 0.9", "graph exact")
        cells = [f"{row[key]:.3f}" if key in row else "" for key in shown]
        print(f"| {name} | {row['scenes']} | {' | '.join(cells)} | {row['seconds']:.2f} |", flush=True)
    if errors:
        print("\n" + errors)
    if real_folder() is not None and {"graspnet", "ycbv"} & set(chosen):
        report_sizes(real_folder(), options)


if __name__ == "__main__":
    sys.exit(status_of(main))
