"""Compare the methods of inference from bare depth images on the same made scenes: how right, how fast, how alike.

    python scripts/compare_methods.py                    20 scenes: settled, tower and mixed in turn
    python scripts/compare_methods.py tower -n 10        other ones

The first table is of `scripts/evaluate.py`: objects found, exact graphs, seconds. The second compares what each method
says of the probability of every edge "this true object rests on that one", and of every type ("it is a cube"), with
what `auto` says: the mean and the largest difference, and how many differ by more than 0.1.
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent))

from evaluate import truth_scene  # noqa: E402
from scene_makers import SETS, make_scene  # noqa: E402

from derender.cli import status_of
from derender.evaluation.metrics import compare_scenes  # noqa: E402
from derender.report.scene_json import scene_json  # noqa: E402
from derender.structures.infer import infer_structure  # noqa: E402
from derender.structures.options import Options  # noqa: E402

METHODS = ("auto", "mcmc", "smc")
NEAR = 0.04  # metres between centres of what is one object


def statements(posterior, truth):
    """Return {(true child, "on", true parent or floor) or (true object, "is", type): probability} of a posterior.

    truth : made objects.
    """
    centres = np.array([np.asarray(item["pose"], float)[:3, 3] for item in truth])
    found: dict = {}
    for part in posterior.parts:
        poses, who = part.graph.poses(), {}
        for vertex in part.graph.vertices:
            if vertex.body.size() is not None and len(centres):
                away = np.linalg.norm(centres - poses[vertex.name][:3, 3], axis=1)
                who[vertex.name] = int(np.argmin(away)) if away.min() < NEAR else "other"
        for vertex in part.graph.vertices:
            if vertex.name in who:
                own = who[vertex.name]
                for key in ((own, "on", who.get(vertex.parent, vertex.parent)), (own, "is", vertex.shape)):
                    found[key] = found.get(key, 0.0) + part.weight
    return found


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sets", nargs="*", default=["settled", "tower", "mixed"], help=f"of {', '.join(SETS)}")
    parser.add_argument("-n", type=int, default=20, help="scenes in all")
    parser.add_argument("--first", type=int, default=0, help="number of the first scene of each set (its seed)")
    arguments = parser.parse_args()
    unknown = set(arguments.sets) - set(SETS)
    if unknown:
        parser.error(f"no such set: {', '.join(sorted(unknown))}")
    warm = make_scene(np.random.default_rng(0), "settled")
    results = {method: [] for method in METHODS}
    seconds = {method: [] for method in METHODS}
    apart = {method: [] for method in METHODS}
    for method in METHODS:
        infer_structure(warm["depth"], warm["camera"], Options(method=method), np.random.default_rng(0))
    for number in range(arguments.n):
        name, k = arguments.sets[number % len(arguments.sets)], arguments.first + number // len(arguments.sets)
        scene = make_scene(np.random.default_rng([k, SETS.index(name)]), name)
        truth, hidden = truth_scene(scene)
        told = {}
        for method in METHODS:
            start = time.perf_counter()
            posterior = infer_structure(
                scene["depth"], scene["camera"], Options(method=method), np.random.default_rng(k)
            )
            seconds[method].append(time.perf_counter() - start)
            results[method].append(compare_scenes(scene_json(posterior.best_graph()), truth, ignored=hidden))
            told[method] = statements(posterior, scene["objects"])
            for key in set(told["auto"]) | set(told[method]):
                apart[method].append(abs(told[method].get(key, 0.0) - told["auto"].get(key, 0.0)))
    print(f"{arguments.n} scenes of {', '.join(arguments.sets)}, from number {arguments.first}\n")
    print("| method | F1 @ 0.5 | F1 @ 0.75 | F1 @ 0.9 | graph exact | median s | longest s |\n" + "|---" * 7 + "|")
    for method in METHODS:
        cells = []
        for threshold in ("0.5", "0.75", "0.9"):
            counts = [result["objects"][threshold] for result in results[method]]
            hits, said, true = (sum(c[key] for c in counts) for key in ("hits", "predicted", "truth"))
            cells.append(f"{2 * hits / max(said + true, 1):.3f}")
        cells.append(f"{np.mean([result['graph_exact'] for result in results[method]]):.3f}")
        cells += [f"{np.median(seconds[method]):.2f}", f"{max(seconds[method]):.2f}"]
        print(f"| {method} | {' | '.join(cells)} |")
    print("\n| beside auto | edges and types | mean difference | largest | above 0.1 |\n" + "|---" * 5 + "|")
    for method in METHODS[1:]:
        away = np.array(apart[method])
        print(f"| {method} | {len(away)} | {away.mean():.4f} | {away.max():.3f} | {int((away > 0.1).sum())} |")


if __name__ == "__main__":
    sys.exit(status_of(main))
