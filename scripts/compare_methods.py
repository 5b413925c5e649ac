"""Compare the methods of inference from bare depth images on the same made scenes: how right, how fast, how alike.

    python scripts/compare_methods.py                    10 draws of the prior that mcmc infers under
    python scripts/compare_methods.py tower -n 5         scenes of scripts/evaluate.py

`mcmc` jumps under the default prior of open structure and shares nothing with `auto` but the scene that the search
finds first, so that where they agree, two ways of weighing structures do. The first table is that of
`scripts/evaluate.py` (objects found, exact graphs, seconds), and how many posteriors are trusted. The second compares
what each method says of the probability of every edge "this true object rests on that one", and of every type ("it is a
cube"), with what `auto` says: the mean and the largest difference, and how many differ by more than 0.1.
"""

import argparse
import sys
import time

import numpy as np
from arguments import at_least_one
from evaluate import ENOUGH_PIXELS, truth_scene

from derender.cli import status_of
from derender.document import read_prior_document
from derender.evaluation.metrics import compare_scenes
from derender.posterior.forward import draw_documents, observe
from derender.render.renderers import find_renderer
from derender.report.scene_json import scene_json
from derender.report.tables import parameter_rows
from derender.results.trust import chain_doubts
from derender.sampling.chains import SCENES, stream
from derender.structures.infer import infer_structure
from derender.structures.jumps.run import DEFAULT_PRIOR
from derender.structures.options import Options
from worlds.made_scenes import SETS, make_scene

METHODS = ("auto", "mcmc")
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


def made_scene(name, number):
    """Return (depth (H, W), camera, objects in the contract's JSON, names of those hardly seen) of one scene."""
    if name != DEFAULT_PRIOR:
        scene = make_scene(stream(number, SCENES, SETS.index(name)), name)
        truth, hidden = truth_scene(scene)
        return scene["depth"], scene["camera"], truth["objects"], hidden
    draw = next(draw_documents(read_prior_document(name), 1, number, {}))
    depth, label = find_renderer("raycast").render_depth(draw.graph.solids(), draw.camera)
    names = draw.graph.solid_names
    hidden = [solid for k, solid in enumerate(names) if np.sum(label == k) < ENOUGH_PIXELS]
    return observe(draw.rng, depth, draw.likelihood), draw.camera, scene_json(draw.graph)["objects"], hidden


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sets", nargs="*", default=[DEFAULT_PRIOR], help=f"of {', '.join((DEFAULT_PRIOR, *SETS))}")
    parser.add_argument("-n", type=at_least_one, default=10, help="scenes in all")
    parser.add_argument("--first", type=int, default=0, help="number of the first scene of each set (its seed)")
    arguments = parser.parse_args()
    unknown = set(arguments.sets) - {DEFAULT_PRIOR, *SETS}
    if unknown:
        parser.error(f"no such set: {', '.join(sorted(unknown))}")
    results = {method: [] for method in METHODS}
    seconds = {method: [] for method in METHODS}
    apart = {method: [] for method in METHODS}
    trusted = dict.fromkeys(METHODS, 0)
    for number in range(arguments.n):
        name, k = arguments.sets[number % len(arguments.sets)], arguments.first + number // len(arguments.sets)
        depth, camera, objects, hidden = made_scene(name, k)
        solids = [item for item in objects if item["size"] is not None]
        told = {}
        for method in METHODS:
            start = time.perf_counter()
            posterior = infer_structure(depth, camera, Options(method=method), np.random.default_rng(k))
            seconds[method].append(time.perf_counter() - start)
            results[method].append(
                compare_scenes(scene_json(posterior.best_graph()), {"objects": objects}, ignored=hidden)
            )
            best = posterior.best_part
            periods = dict(zip(best.addresses, best.periods, strict=True))
            trusted[method] += not chain_doubts(posterior, parameter_rows(best.addresses, best.values, periods))
            told[method] = statements(posterior, solids)
            for key in set(told["auto"]) | set(told[method]):
                apart[method].append(abs(told[method].get(key, 0.0) - told["auto"].get(key, 0.0)))
    print(f"{arguments.n} scenes of {', '.join(arguments.sets)}, from number {arguments.first}\n")
    print(
        "| method | F1 @ 0.5 | F1 @ 0.75 | F1 @ 0.9 | graph exact | trusted | median s | longest s |\n"
        + "|---" * 8
        + "|"
    )
    for method in METHODS:
        cells = []
        for threshold in ("0.5", "0.75", "0.9"):
            counts = [result["objects"][threshold] for result in results[method]]
            hits, said, true = (sum(c[key] for c in counts) for key in ("hits", "predicted", "truth"))
            cells.append(f"{2 * hits / max(said + true, 1):.3f}")
        cells.append(f"{np.mean([result['graph_exact'] for result in results[method]]):.3f}")
        cells += [f"{trusted[method]}", f"{np.median(seconds[method]):.2f}", f"{max(seconds[method]):.2f}"]
        print(f"| {method} | {' | '.join(cells)} |")
    print("\n| beside auto | edges and types | mean difference | largest | above 0.1 |\n" + "|---" * 5 + "|")
    for method in METHODS[1:]:
        away = np.array(apart[method])
        print(f"| {method} | {len(away)} | {away.mean():.4f} | {away.max():.3f} | {int((away > 0.1).sum())} |")


if __name__ == "__main__":
    sys.exit(status_of(main))
