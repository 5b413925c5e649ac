"""Break the heart of inference in one named place at a time, and see whether a test notices.

    python scripts/mutate.py --check            does the table still fit the code?
    python scripts/mutate.py                    all of it: ten minutes, once kernels are compiled
    python scripts/mutate.py jumps -j 2         those of whose title or file a word is part, two at a time

Each mutation is made in a copy of the tree, where the tests that should notice it are run; it is caught where one of
them fails, and survives where all pass. Prints one line for each and what survived; exits with 1 where more than
ALLOWED did, or where the table no longer fits.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import Queue
from typing import NamedTuple

from arguments import at_least_one

ROOT = Path(__file__).resolve().parent.parent
COPIED = ("derender", "data", "tests", "scripts", "pyproject.toml", "README.md", "Makefile")
ALLOWED = 3  # survivors
TIMEOUT = 1800.0  # seconds for the tests of one mutation

JUMPS = ("tests/structures/test_jumps.py", "tests/structures/test_jump_choices.py")
KERNELS = ("tests/posterior/test_kernels.py",)
ANEW = ("tests/structures/test_contacts_anew.py",)
COMPILED = ("tests/posterior/test_compiled.py", *ANEW, *KERNELS)
WEIGHTS = ("tests/structures/test_structure_weights.py",)
DRAWS = ("tests/structures/test_graph_posterior.py", *WEIGHTS)
AGAIN = ("tests/structures/test_weighed_again.py",)
BLUR = ("tests/structures/test_blur_sought.py",)
FLUSH = ("tests/structures/test_flush_cuts.py",)
STEPS = ("tests/sampling/test_metropolis.py",)
SMC = ("tests/posterior/test_smc.py",)
RELATIONS = ("tests/structures/test_relations.py",)
SCORE = ("tests/render/test_likelihoods.py", "tests/render/test_engine.py")
PHYSICS = ("tests/physics/test_verdict.py", "tests/physics/test_simulate.py")


class Mutation(NamedTuple):
    """file : below derender/; old : text that stands in it once; new : in its place; tests : that should notice."""

    title: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]


MUTATIONS = [
    Mutation(*row)
    for row in (
        # the decision, the adaptation, tempered populations
        ("accept: sign of the threshold", "sampling/metropolis.py", "math.log(1.0 - rng.random())",
         "-math.log(1.0 - rng.random())", STEPS),
        ("accept: half as often", "sampling/metropolis.py", "accepted = log_threshold(rng) < log_ratio",
         "accepted = log_threshold(rng) + 0.7 < log_ratio", STEPS),
        ("walk: accepts half as often", "sampling/metropolis.py", "accepted = compiled_log_threshold(rng) < log_ratio",
         "accepted = compiled_log_threshold(rng) + 0.7 < log_ratio", STEPS),
        ("walk: adapts to refusals", "sampling/metropolis.py", "rate = 1.0 if accepted else 0.0",
         "rate = 0.0 if accepted else 1.0", STEPS),
        ("adapted scale: wrong way", "sampling/metropolis.py", "gain * (rate - wanted)", "gain * (wanted - rate)",
         (*STEPS, *COMPILED)),
        ("adapted scale: unlimited", "sampling/metropolis.py", "max(-MOST_CHANGE, min(MOST_CHANGE, gain", "((gain",
         STEPS),
        ("smc: mass of the terms x .9", "posterior/sampler.py", "most + np.log(np.mean(weights))",
         "most + np.log(0.9 * np.mean(weights))",
         SMC),
        ("smc: mean weight x 1.1", "posterior/sampler.py", "np.max(logs) + np.log(np.mean(weights))",
         "np.max(logs) + np.log(1.1 * np.mean(weights))", SMC),
        ("smc: no resampling", "posterior/sampler.py", "chosen = systematic(rng, weights)",
         "chosen = np.arange(len(weights))",
         SMC),
        ("smc: cold moves", "posterior/sampler.py", "tuning._replace(temperature=present, scale=scale)",
         "tuning._replace(temperature=1.0, scale=scale)", SMC),
        ("streams: sampled scenes share the seed's own", "sampling/chains.py", "spawn_key=key)", "spawn_key=key[:1])",
         ("tests/sampling/test_streams.py",)),
        ("diagnostics: r-hat without folding", "sampling/diagnostics.py",
         "max(_r_hat(ranks), _r_hat(folded))", "_r_hat(ranks)",
         ("tests/sampling/test_diagnostics.py",)),
        ("diagnostics: ess of whole chains", "sampling/diagnostics.py", "halves = _split(draws)",
         "halves = draws", ("tests/sampling/test_diagnostics.py",)),
        # kernels of one structure
        ("step: no temperature", "posterior/compiled/evaluate.py",
         "temperature * (values[NEXT, DENSITY] - values[NOW, DENSITY])",
         "values[NEXT, DENSITY] - values[NOW, DENSITY]",
         KERNELS),
        ("relocate: no ratio", "posterior/kernels/relocate.py", "- math.log(mixture_density(places, periods, new))",
         "- math.log(mixture_density(places, periods, old))", ANEW),
        ("resimulate: own prior left out", "posterior/kernels/base.py",
         "return log_prior(unknowns, laws, values[NOW]) - log_prior(unknowns, laws, values[NEXT])", "return 0.0",
         KERNELS),
        ("flip: a third of a turn", "posterior/kernels/base.py", "values[NOW, start] + 0.5 * period",
         "values[NOW, start] + 0.33 * period", KERNELS),
        ("space: turns of twice the length", "posterior/space.py", "scale = 0.5 if angle < 1e-12 else math.sin(0.5 *",
         "scale = 0.5 if angle < 1e-12 else math.sin(1.0 *", KERNELS),
        ("step: no jacobian", "posterior/compiled/evaluate.py", "values[NOW, PRIOR] + correction",
         "values[NOW, PRIOR]", COMPILED),
        ("compiled: area element of contacts", "posterior/compiled/evaluate.py",
         "log_jacobian -= math.log(area_element(", "log_jacobian -= 0.5 * math.log(area_element(", COMPILED),
        ("populations: each counts alike", "posterior/sampler.py", "np.exp(logs - logs.max())",
         "np.ones(len(logs))", ("tests/posterior/test_pilots.py",)),
        # terms of priors
        ("rests-on x .25", "scene/priors/terms.py", "total -= 0.5 * (away / row[SOFTNESS]) ** 2",
         "total -= 0.125 * (away / row[SOFTNESS]) ** 2",
         RELATIONS),
        # reversible jumps
        ("jumps: birth without leaves", "structures/jumps/base.py",
         "math.log(0.5) - math.log(len(leaves)) if", "math.log(0.5) if", JUMPS),
        ("jumps: birth twice as often", "structures/jumps/base.py",
         "if rng.random() < 0.5:\n            return w", "if rng.random() < 0.67:\n            return w", JUMPS),
        ("jumps: density of a list, not a set", "structures/jumps/base.py",
         "density + self.prior.log_orderings(graph) if", "density if", JUMPS),
        ("jumps: rotations' element", "structures/jumps/proposal.py", "return normal + HAAR - math.log(element)",
         "return normal + HAAR", JUMPS),
        ("jumps: births' mixture share", "structures/jumps/proposal.py",
         "total += (1.0 - self.on_prior) * component.weight", "total += component.weight", JUMPS),
        ("jumps: bearers not counted", "structures/jumps/base.py", "-math.log(len(bearers))", "0.0", JUMPS),
        # weights of structures of a bare image
        ("merge: one box's evidence only", "structures/unions.py", "Block(best, own)",
         "Block(best, [i])", WEIGHTS),
        ("blocks weighed by near evidence", "structures/weighing.py", "found.log + block.apart - held.log - own.apart",
         "block.near - own.near", ("tests/structures/test_weighing.py",)),
        ("focal length: stretch of pixels dropped", "results/focal_length.py",
         "np.diag([camera.fx / focal, camera.fy / focal, 1.0])", "np.eye(3)", ("tests/results/test_focal.py",)),
        ("hidden: floor beyond what is seen", "structures/unexplained.py",
         "(bare <= bare[seen].max())", "np.isfinite(bare)",
         ("tests/structures/test_hidden.py",)),
        ("what is beaten shares nothing", "structures/graph_posterior.py", "leader.places[::-1]", "None", DRAWS),
        ("a close rival asks for no search", "structures/graph_posterior.py", "odds > -RIVAL", "odds > 1.0", AGAIN),
        ("outliers ask for no search", "structures/graph_posterior.py", " or leaves_outliers(best.sensor)", "", AGAIN),
        ("known outliers ask for a search", "structures/draws/refined.py", " if name not in known", "", AGAIN),
        ("flying pixels ask for no search", "structures/draws/refined.py", ', "flying": 0.0}', "}", AGAIN),
        ("known outliers hide a wrong blur", "structures/draws/refined.py", '"outlier" not in fitted or ', "", BLUR),
        ("two weighings: by the variances", "structures/graph_posterior.py", "weights=1.0 / squares",
         "weights=squares", AGAIN),
        ("two weighings: lesser modes too", "structures/graph_posterior.py", "abs(height(a) - height(b)) < HIGHER",
         "True", AGAIN),
        ("jitter lets go of contacts", "physics/intervention.py",
         "/ np.sqrt(1.0 + values.clip(0.0) / (OPENS * matter.unit) ** 2)", "", ("tests/physics/test_jitter.py",)),
        ("whole: normal alone", "structures/weighing.py", "log += found.log - near_evidence",
         "log += 0.0 * near_evidence", ("tests/structures/test_structure_weights.py",)),
        ("near evidence: no volume", "structures/draws/refined.py", "return height - 0.5 * float(np.linalg.slogdet",
         "return height - 0.0 * float(np.linalg.slogdet", DRAWS),
        ("evidence: shares of the mixture left out", "sampling/evidence.py",
         "return points, np.log(self.shares)[:, None] + own", "return points, np.array(own)",
         ("tests/sampling/test_evidence.py", *DRAWS)),
        ("pcn: constant", "structures/draws/metropolis.py", "(1.0 - np.sqrt(1.0 - reach * reach)) * here",
         "(1.0 - np.sqrt(1.0 - 0.8 * reach * reach)) * here", DRAWS),
        ("pcn: ratio left out", "structures/draws/metropolis.py", "(new - likelihood) - drawn", "(new - likelihood)",
         DRAWS),
        ("structure prior dropped", "structures/draws/chart.py", "return chart.structural + log_prior_about",
         "return log_prior_about", WEIGHTS),
        ("turns: box symmetry", "structures/draws/chart.py", "turns = 0.5 * np.pi", "turns = np.pi", WEIGHTS),
        ("places on a top", "structures/draws/chart.py", "total -= np.log(touching_area(row, on))",
         "total -= np.log(2.0 * touching_area(row, on))", DRAWS),
        ("sizes: box symmetry", "detection/solids/beliefs.py", "total / (2.0 if upright else 6.0)",
         "total / (1.0 if upright else 6.0)", ("tests/structures/test_structure_sizes.py", *WEIGHTS)),
        ("sizes: spread doubled", "detection/solids/beliefs.py",
         "inside = min(max(np.log(extent), row[LOW]), row[HIGH])",
         "inside = min(max(0.5 * (np.log(extent) + np.log(0.085)), row[LOW]), row[HIGH])",
         ("tests/structures/test_structure_sizes.py", *DRAWS)),
        ("tipping x 10", "structures/draws/chart.py", "np.log(loose.tipping)", "np.log(10.0 * loose.tipping)",
         (*FLUSH, *DRAWS)),
        ("bridges: prior odds", "structures/bridges.py", "odds = prior_odds * loose.within", "odds = loose.within",
         ("tests/structures/test_bridges.py",)),
        # what is seen
        ("robust: what flies counts more", "render/likelihoods/pixelwise.py", "0.25 * on_one", "0.35 * on_one", SCORE),
        ("engine: nothing flies on the far side", "render/raycast/region.py",
         "_on_surface(told, farthest, constants)", "_on_surface(told, nearest, constants)", SCORE),
        ("gaussian: no normaliser", "render/likelihoods/pixelwise.py", "- math.log(spread) -", "-", SCORE),
        ("gaussian: half the residuals' weight", "render/likelihoods/pixelwise.py",
         "density = -0.5 * (residual / spread) ** 2", "density = -0.25 * (residual / spread) ** 2", SCORE),
        # what happens next
        ("fall angle tripled", "physics/verdict.py", "np.deg2rad(10.0)", "np.deg2rad(30.0)", PHYSICS),
        ("calm a 25th as long", "physics/verdict.py", "CALM_TIME = 8e-3, 4.0", "CALM_TIME = 8e-3, 0.16",
         PHYSICS),
    )
]  # fmt: skip


def misfits() -> list[str]:
    """Return a line for each mutation whose old text does not stand in its file once, or whose tests are gone."""
    found = []
    for mutation in MUTATIONS:
        path = ROOT / "derender" / mutation.file
        count = path.read_text().count(mutation.old) if path.exists() else 0
        if count != 1:
            found.append(f"{mutation.title}: {mutation.old!r} stands {count} times in derender/{mutation.file}")
        found += [f"{mutation.title}: there is no {test}" for test in mutation.tests if not (ROOT / test).exists()]
    return found


def copied(folder: Path) -> Path:
    """Return a copy of the tree in a folder, with what is compiled there: most kernels do not depend on a mutation."""
    ignored = shutil.ignore_patterns(".*_cache")
    for name in COPIED:
        source = ROOT / name
        if source.is_dir():
            shutil.copytree(source, folder / name, ignore=ignored)
        else:
            shutil.copy(source, folder)
    return folder


def outcome(mutation: Mutation, copies: Queue) -> str:
    """Return "caught", "survived", or why the tests said neither; made in a copy of the tree, which is as it was after.

    copies : folders that nobody works in; what was compiled for one mutation and does not depend on it is there still.
    """
    folder = copies.get()
    file = folder / "derender" / mutation.file
    whole = file.read_text()
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", "-m", "", *mutation.tests]
    environment = os.environ | {"PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1"}
    try:
        file.write_text(whole.replace(mutation.old, mutation.new))
        done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, timeout=TIMEOUT)
    except subprocess.TimeoutExpired:
        return "caught"  # it goes on for ever
    finally:
        file.write_text(whole)
        copies.put(folder)
    return {0: "survived", 1: "caught"}.get(done.returncode, f"the tests did not run: exit {done.returncode}")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("words", nargs="*", help="parts of titles or files; none: all mutations")
    parser.add_argument("--check", action="store_true", help="only see whether the table fits the code")
    parser.add_argument("-j", "--jobs", type=at_least_one, default=1, help="mutations at a time")
    arguments = parser.parse_args()
    wrong = misfits()
    for line in wrong:
        print(line, file=sys.stderr)
    chosen = [
        mutation for mutation in MUTATIONS
        if not arguments.words or any(word in f"{mutation.title} {mutation.file}" for word in arguments.words)
    ]  # fmt: skip
    if arguments.check or wrong:
        print(f"{len(MUTATIONS)} mutations, {len(wrong)} that no longer fit")
        return int(bool(wrong))
    survived, jobs = [], arguments.jobs
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(jobs) as pool:
        copies: Queue = Queue()
        for number in range(jobs):
            (Path(folder) / str(number)).mkdir()
            copies.put(copied(Path(folder) / str(number)))
        for mutation, what in zip(chosen, pool.map(outcome, chosen, [copies] * len(chosen)), strict=True):
            print(f"{what:<10} {mutation.title} ({mutation.file})", flush=True)
            if what != "caught":
                survived.append(mutation.title)
    print(f"{len(chosen) - len(survived)} of {len(chosen)} caught; not caught: {', '.join(survived) or 'none'}")
    return int(len(survived) > ALLOWED)


if __name__ == "__main__":
    sys.exit(main())
