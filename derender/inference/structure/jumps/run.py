"""Scene graphs under a prior of open structure, sampled by jump chains or structure SMC: `infer --scene PRIOR --method
mcmc` or `smc`. Without a prior see structure/leaps."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from derender.errors import DerenderError
from derender.inference.bottom_up.given_floor import read_floor
from derender.inference.posterior import Posterior
from derender.inference.structure.jumps import mixture
from derender.inference.structure.jumps.base import Target
from derender.inference.structure.jumps.chain import jump_chain, posterior_of
from derender.inference.structure.jumps.proposal import Hypothesis, HypothesisProposal
from derender.inference.structure.jumps.slots import SlotImage
from derender.inference.structure.jumps.smc import structure_smc
from derender.inference.structure.jumps.start import (
    base_graph,
    hypotheses_of,
    root_pose_near,
    start_graph,
)
from derender.inference.structure.jumps.vocabulary import Vocabulary
from derender.model.scene import SceneGraph

DRAWS, CHAINS, THIN, WARMUP = 400, 2, 20, 4000
PARTICLES, STEPS, ANNEAL = 40, 60, 4
EXTRA = 1  # objects beyond those seen that SMC makes room for


def sample_structures(
    rng: np.random.Generator,
    prior,
    likelihood: str,
    camera,
    image: np.ndarray,
    start: Sequence[SceneGraph],
    hypotheses: Sequence[Hypothesis] = (),
    method: str = "mcmc",
    draws: int = DRAWS,
    chains: int = CHAINS,
    thin: int = THIN,
    warmup: int = WARMUP,
    most: int | None = None,
    values: Mapping[str, float] | None = None,
    weights: Mapping[str, float] | None = None,
    progress: Callable[[float, str], None] | None = None,
) -> Posterior:
    """Return the posterior over scene graphs.

    Parameters
    ----------
    prior : Algorithm1Prior or GrammarPrior. likelihood, values : registered name and its numbers.
    image : (H, W) metres, NaN where nothing returned.
    start : scenes of positive prior density; chains start from them in turn, SMC from the first one's base.
    hypotheses : what births are drawn from besides the prior.
    method : "mcmc", or "smc" with `draws` particles for each of `chains` populations.
    thin, warmup : steps between draws of a chain, and before the first.
    most : objects at which SMC stops; by default those of the start and one more.
    weights : of moves by name, see `derender.inference.structure.jumps.mixture`.

    Raises
    ------
    DerenderError : a start that the prior rules out, a prior with named objects, an unknown method.
    """
    if method not in ("mcmc", "smc"):
        raise DerenderError(f"{method!r} does not sample structures", "--method", "mcmc or smc does")
    parts = mixture(weights)
    found = []
    for chain, child in enumerate(rng.spawn(chains)):
        graph = start[chain % len(start)]
        words = Vocabulary(prior, HypothesisProposal(hypotheses) if hypotheses else None)
        target = Target(prior, SlotImage(camera, image, likelihood, values))
        if method == "mcmc" and target.log_prior(graph) == -np.inf:
            raise DerenderError("the prior rules out the scene to start from", remedy="widen the prior")

        def tell(fraction: float, chain=chain) -> None:
            if progress:
                progress((chain + fraction) / chains, "jumping" if method == "mcmc" else "adding objects")

        if method == "mcmc":
            found.append(jump_chain(child, target, words, graph, draws, warmup, thin, parts, tell))
            continue
        bare = graph
        for name in reversed(words.grown(graph)):
            bare = bare.remove(name) if name in bare.names else bare
        size = len(words.grown(graph)) + EXTRA if most is None else most
        found.append(structure_smc(child, target, words, bare, draws, size, parts, STEPS, ANNEAL, tell))
    return posterior_of(Vocabulary(prior), found)


def infer_by_jumps(image, camera, options, document, rng=None, progress=None) -> Posterior:
    """Infer what there is under a document's prior of open structure, by jumps from the fast search's scene.

    options : as of `infer_structure`: method "mcmc" or "smc", shapes, max_objects, may_overlap, may_float, floor,
        chains, draws, warmup (steps of a chain before its first draw), seed.

    Raises
    ------
    DerenderError : an option that these jumps know nothing about.
    """
    from derender.inference.structure.infer import point_estimate, settings_of
    from derender.inference.structure.solids.graph import scene_graph

    method, chain = options["method"], options["method"] == "mcmc"
    if options.get("resume"):
        raise DerenderError("jumps under a prior of open structure keep no checkpoints", "--resume", "leave it out")
    if not chain and options.get("warmup") is not None:
        raise DerenderError("populations have no warm-up", "--warmup", "leave it out, or take --method mcmc")
    rng = np.random.default_rng(options.get("seed")) if rng is None else rng
    if progress:
        progress(0.0, "searching for solids")
    prior = document.prior
    settings = settings_of({**options, "prior": prior})
    depth = np.where(np.isfinite(image) & (image > 0), image, np.nan)
    state, seen = point_estimate(rng, depth, camera, settings, plane=read_floor(options.get("floor")))
    graph = scene_graph(state, seen.floor.pose, floating=settings.may_float)
    words = Vocabulary(prior)
    base = base_graph(words, root_pose_near(prior.root, np.asarray(seen.floor.pose, float)), rng)
    start = start_graph(words, base, graph)
    likelihood, values = _likelihood_of(document, seen, settings, depth)
    warmup = options.get("warmup")
    posterior = sample_structures(
        rng, prior, likelihood, camera, depth, [start], hypotheses_of(words, graph), method,
        int(options.get("draws") or (DRAWS if chain else PARTICLES)), int(options.get("chains") or CHAINS),
        warmup=WARMUP if warmup is None else int(warmup), most=options.get("max_objects"), values=values,
        progress=progress,
    )  # fmt: skip
    return replace(posterior, meta={**posterior.meta, "likelihood": {"type": likelihood, **(values or {})}})


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
