"""Scene graphs under a prior of open structure, by jump chains or structure SMC: `infer --method mcmc` or `smc`.

Without a prior, images are inferred under DEFAULT_PRIOR with the floor where it was seen and the noise that it shows.
Chains start from the search's one best scene, and births are proposed about its solids; nothing that `auto` weighs is
used, so the weights of the two come about in different ways.
"""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from derender import __version__
from derender.detection.given_floor import read_floor
from derender.document import Document, read_prior_document
from derender.errors import DerenderError
from derender.results.posterior import Posterior
from derender.sampling import workers
from derender.sampling.chains import Plan
from derender.sampling.checkpoint import fingerprint
from derender.scene.priors.root import FixedRoot
from derender.structures.jumps.base import Target
from derender.structures.jumps.chain import posterior_of
from derender.structures.jumps.sampler import JumpSampler
from derender.structures.jumps.start import base_graph, hypotheses_of, root_pose_near, root_seen, start_graph
from derender.structures.jumps.vocabulary import Vocabulary

DEFAULT_PRIOR = "bare-image"  # of images that come without one
DRAWS, CHAINS, THIN, WARMUP = 400, 2, 20, 4000
PARTICLES = 40
SEGMENT = 10  # draws of a chain between two moments at which it can be stopped
EXTRA = 1  # objects beyond those seen that SMC makes room for


def infer_by_jumps(image, camera, options, document, rng=None, progress=None) -> Posterior:
    """Infer what there is under a document's prior of open structure, by jumps from the fast search's scene.

    document : None for the default prior, as `bare_document` has it.
    options : Options: method "mcmc" or "smc", shapes, max_objects, may_overlap, may_float, floor,
        chains, draws, warmup (steps of a chain before its first draw), seed; jobs, folder of checkpoints, resume.

    Raises
    ------
    DerenderError : an option that these jumps know nothing about, or no floor to put solids on.
    """
    from derender.detection.solids.graph import scene_graph
    from derender.structures.infer import explanation_of, point_estimate, settings_of

    method, chain = options.method, options.method == "mcmc"
    if not chain and options.warmup is not None:
        raise DerenderError("populations have no warm-up", "--warmup", "leave it out, or take --method mcmc")
    rng = np.random.default_rng(options.seed) if rng is None else rng
    if progress:
        progress(0.0, "searching for solids")
    plane = read_floor(options.floor)
    if document is None and isinstance(plane, str):
        remedy = "give a plane, leave --floor out, or take --method auto"
        raise DerenderError(f"the prior {DEFAULT_PRIOR} has a floor", "--floor", remedy)
    prior: Any = (document or read_prior_document(DEFAULT_PRIOR)).prior
    settings = settings_of(replace(options, prior=prior))._replace(free_forms=False)
    depth = np.where(np.isfinite(image) & (image > 0), image, np.nan)
    state, seen = point_estimate(rng, depth, camera, settings, plane=plane)
    if document is None:
        document = bare_document(np.asarray(seen.floor.pose, float))
        prior = document.prior
    graph = scene_graph(state, seen.floor.pose, floating=settings.may_float)
    words = Vocabulary(prior)
    base = base_graph(words, root_pose_near(prior.root, np.asarray(seen.floor.pose, float)), rng)
    start = start_graph(words, base, graph)
    likelihood, values = _likelihood_of(document, seen, settings, depth)
    draws, chains = options.draws or (DRAWS if chain else PARTICLES), options.chains or CHAINS
    most = options.max_objects or len(words.grown(start)) + EXTRA
    sampler = JumpSampler(prior, start, camera, depth, likelihood, values, hypotheses_of(words, graph), method, THIN,
                          SEGMENT if chain else draws, int(most))  # fmt: skip
    if chain and Target(prior).log_prior(start) == -np.inf:
        raise DerenderError("the prior rules out the scene to start from", remedy="widen the prior")
    warmup = WARMUP if options.warmup is None else options.warmup
    folder = None if options.folder is None else Path(options.folder) / "checkpoint"
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
    decides = [options.deciding()] + ([] if chain else [str(draws)])
    run = fingerprint(__version__, *decides, depth.tobytes(), repr(camera), likelihood, repr(values),
                      sampler.start(rng)["now"].tobytes(), repr(sampler.hypotheses))  # fmt: skip
    plan = Plan(sampler, int(rng.integers(2**63)), chains, -(-warmup // THIN) if chain else 0, draws, folder, run,
                options.resume)  # fmt: skip
    total, done = chains * (plan.warmup + plan.draws), dict.fromkeys(range(chains), 0)

    def report(number: int, steps: int, _: int) -> None:
        done[number] = steps
        if progress:
            progress(sum(done.values()) / total, "jumping" if chain else "adding objects")

    outcome = workers.run(plan, options.jobs or 1, True, report)
    found = [sampler.draws(record) for record in outcome.records.values() if record.drawn]
    if not found:
        raise KeyboardInterrupt
    if folder is not None and not outcome.interrupted:
        shutil.rmtree(folder)
    posterior = posterior_of(words, found)
    explanation = explanation_of(posterior, seen, depth, camera)
    meta = {
        **posterior.meta,
        "likelihood": {"type": likelihood, **(values or {})},
        "interrupted": outcome.interrupted,
        "lost_chains": outcome.lost,
    }
    return replace(posterior, explanation=explanation, meta=meta)


def bare_document(floor_pose: np.ndarray) -> Document:
    """Return the default prior for a bare image: the floor at the pose (4, 4) seen, no likelihood of its own."""
    document = read_prior_document(DEFAULT_PRIOR)
    prior: Any = document.prior
    return replace(document, prior=replace(prior, root=FixedRoot(root_seen(floor_pose))), likelihood=None)


def _likelihood_of(document, seen, settings, depth) -> tuple[str, dict[str, float]]:
    """Return the likelihood's name and numbers: the document's, else a robust one with the noise seen on the floor."""
    if document.likelihood is not None:
        given = document.likelihood.values
        return document.likelihood.type, {k: v if isinstance(v, float) else float(v.mean()) for k, v in given.items()}
    sigma = float(np.median(seen.sigma[seen.mask])) if seen.mask.any() else 0.002
    temper = settings.for_correlation(seen.correlation).temper
    pixels = float(np.isfinite(depth).sum())
    missing = float(np.mean(~np.isfinite(depth)))
    return "robust", {
        "sigma": max(sigma, 0.0005), "blur": 0.5, "outlier": 0.05, "effective_pixels": pixels / temper,
        "missing": min(max(missing, 0.01), 0.9), "missing_edge": min(max(2.0 * missing, 0.05), 0.95),
    }  # fmt: skip
