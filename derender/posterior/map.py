"""Maximum a posteriori estimation of the numbers of a scene graph whose structure is given (A.3, Figure 5).

Any scene is led to its mode by a walk ever colder (`cooled`); where none of its solids is a mesh, two ways lead on.
`gauss-newton` (the default): from each start a coarse image is scanned and descended, then the full one, by
Levenberg-Marquardt on the exact Jacobian of the antialiased image. `gradient`: the paper's steps of fixed length. Both
keep every state inside the domain, angles going round their period.
"""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from derender.errors import DerenderError
from derender.posterior.ascent import Cost, fixed_steps, levenberg, new_placement
from derender.posterior.compiled.backend import backend_of
from derender.posterior.kernels.base import first_tuning, mixture, rescale
from derender.registry import suggest
from derender.render.blur import blur_taps
from derender.render.raycast.normal_equations import new_misfit
from derender.scene.graph import SceneGraph
from derender.scene.solids import MESH

if TYPE_CHECKING:
    from derender.camera.intrinsics import Camera

METHODS = ("gauss-newton", "gradient", "finite-difference")  # the last: the second, by a derivative that is not exact
COARSE_ROWS = 16  # of the image that a start is looked for in
LATTICE, GENERATORS = 24, (1, 5, 11, 7)  # points of the scan, and their rank-1 lattice in up to four parameters
KEPT = 2  # places of the scan that are descended from
COARSE_STEPS, COARSE_STEPS_ALONE = 4, 12  # with a scan before, and without
COARSE_GAIN = 5.0  # nats; a smaller one ends a descent on the coarse image
COLDER = tuple(2.0 ** np.arange(0.0, 10.0, 0.5))  # what the likelihood is raised to, one after the other
COLD_STEPS, GAIN = 100, 3.0  # at each, of each block of unknowns; of their scales for a rate wrong by 1
DIFFERENCE = 0.01  # step of finite differences, a share of each parameter's range: about a pixel


class Maximum(NamedTuple):
    """Where one ascent ended."""

    values: np.ndarray  # (P,) float64
    log_density: float  # log likelihood at `values`
    path: np.ndarray  # (T + 1, P) the states on the way at full resolution, the last one `values`
    log_densities: np.ndarray  # (T + 1,) theirs
    iterations: int  # steps taken, those on the coarse image included


class MapProblem:
    """The posterior density of some numbers of a scene graph given one depth image, and ways to its top.

    graph : SceneGraph with compiled contacts. addresses : the free numbers, such as "red.contact.theta", "red.side".
    camera : Camera. observed : (height, width) metres, NaN or 0 where nothing returned.
    sigma : metres, a number or (height, width). blur : pixels. background : metres where nothing is hit (Eq. 6).
    limit : nats at which a pixel counts as an outlier; infinite for Eq. 6 itself.
    ranges : {address: (lower, upper)} narrower than the parameters' own; an angle so given no longer goes round. Priors
        are uniform in these ranges.
    edges : False leaves out the occlusion edges of the derivative: wrong, for comparison.

    Raises DerenderError : an unknown address, a contact type without compiled form.
    """

    def __init__(
        self,
        graph: SceneGraph,
        addresses: Sequence[str],
        camera: "Camera",
        observed: np.ndarray,
        *,
        sigma: float = 0.005,
        blur: float = 1.0,
        background: float = 10.0,
        limit: float = math.inf,
        ranges: dict[str, tuple[float, float]] | None = None,
        edges: bool = True,
    ) -> None:
        self.graph, self.addresses = graph, tuple(addresses)
        self.placement, self.values, self.domain = new_placement(graph, self.addresses)
        count = len(self.addresses)
        for address, (low, high) in (ranges or {}).items():
            p = self.addresses.index(address)
            whole = self.domain.period[p] > 0 and abs(high - low - self.domain.period[p]) < 1e-9
            if not whole:
                self.domain.lower[p], self.domain.upper[p], self.domain.period[p] = low, high, 0.0
        observed = np.asarray(observed, float)
        seen = np.isfinite(observed) & (observed > 0)
        spread = np.broadcast_to(np.asarray(sigma, float), observed.shape)
        self._constant = -float(np.sum(np.log(spread[seen]) + 0.5 * math.log(2 * math.pi)))
        kinds = graph.solids().kind
        if (kinds == MESH).any():
            raise DerenderError("meshes have no exact derivative", remedy="give boxes, cubes, cylinders or spheres")
        fine = new_misfit(camera, observed, spread, kinds, count, blur_taps(blur), background, limit)
        factor = max(1, min(camera.width, camera.height) // COARSE_ROWS)
        small = camera.downscaled(factor)
        means, deviations = _blocks(np.where(seen, observed, np.nan), spread, factor)
        taps = blur_taps(blur / factor)
        coarse = new_misfit(small, means, deviations, kinds, count, taps, background, limit)
        self._fine, self._coarse = Cost(fine, self.placement, edges), Cost(coarse, self.placement)

    def scene(self, values: np.ndarray) -> SceneGraph:
        """Return the graph with these (P,) values."""
        return self.graph.with_numbers(dict(zip(self.addresses, map(float, values), strict=True)))

    def log_density(self, values: np.ndarray) -> float:
        """Return Eq. 6's log likelihood on the antialiased image."""
        return self._constant - float(self._fine.at(np.atleast_2d(values))[0])

    def slope(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the gradient (P,) of the log density at `values` and its Gauss-Newton precision (P, P)."""
        values = np.array(values, np.float64)
        self._fine.at(values[None])
        gradient, hessian = self._fine.equations(values)
        return -gradient, hessian

    def random_starts(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Return (count, P) starts, uniform over finite ranges; a number without one stays as the graph has it."""
        low, length = self.domain.lower, self.domain.upper - self.domain.lower
        drawn = rng.uniform(size=(count, len(self.addresses)))
        finite = np.isfinite(low) & np.isfinite(length)
        return np.where(finite, np.where(finite, low, 0) + np.where(finite, length, 0) * drawn, self.values)

    def maximise(
        self,
        starts: np.ndarray | None = None,
        method: str = "gauss-newton",
        iterations: int = 12,
        step: float = 0.05,
        tolerance: float = 0.5,
        explore: bool = True,
    ) -> list[Maximum]:
        """Ascend from each start (S, P), by default from the graph's own values, and return the ends in that order.

        method : one of METHODS.
        iterations : most steps at full resolution. step : alpha of the fixed steps. tolerance : nats.
        explore : look for the right basin on the coarse image first (gauss-newton).
        """
        if method not in METHODS:
            raise DerenderError(f"no method is called {method!r}", remedy=suggest(method, METHODS))
        ends = []
        for start in self.values[None] if starts is None else np.atleast_2d(np.asarray(starts, float)):
            before = 0  # steps on the coarse image
            if method == "gauss-newton":
                values, before = self._explore(start) if explore else (np.array(start, np.float64), 0)
                ascent = levenberg(self._fine, values, self.domain, iterations, tolerance)
            else:
                difference = DIFFERENCE if method == "finite-difference" else 0.0
                ascent = fixed_steps(self._fine, start, self.domain, iterations, step, difference)
            path, densities = ascent.path, self._constant - ascent.costs
            ends.append(Maximum(path[-1], float(densities[-1]), path, densities, before + len(path) - 1))
        return ends

    def _explore(self, start: np.ndarray) -> tuple[np.ndarray, int]:
        """Return the best end, and its steps, of descents on the coarse image from a lattice's best places.

        The lattice begins at `start`, so that a random start makes it random; wrong basins are few on a coarse image.
        """
        count = len(self.addresses)
        start = self.domain.bring(np.asarray(start, float))
        low, length = self.domain.lower, self.domain.upper - self.domain.lower
        places, steps = start[None], COARSE_STEPS_ALONE
        if count <= len(GENERATORS) and np.all(np.isfinite(length)):
            shares = np.outer(np.arange(LATTICE), GENERATORS[:count]) / LATTICE + (start - low) / length
            places, steps = low + length * (shares - np.floor(shares)), COARSE_STEPS
        order = np.argsort(self._coarse.at(places))[:KEPT]
        ends = [levenberg(self._coarse, places[number], self.domain, steps, COARSE_GAIN) for number in order]
        best = min(ends, key=lambda end: end.costs[-1])
        return best.path[-1], len(best.path) - 1


def _blocks(depth: np.ndarray, sigma: np.ndarray, factor: int) -> tuple[np.ndarray, np.ndarray]:
    """Return means of depth, NaN left out, and of sigma over factor x factor blocks; a rest at the edge is cut off."""
    height, width = depth.shape[0] // factor, depth.shape[1] // factor
    shape = (height, factor, width, factor)
    depth = depth[: height * factor, : width * factor].reshape(shape)
    sigma = sigma[: height * factor, : width * factor].reshape(shape)
    seen = np.isfinite(depth)
    total, number = np.where(seen, depth, 0.0).sum(axis=(1, 3)), seen.sum(axis=(1, 3))
    return np.where(number > 0, total / np.maximum(number, 1), np.nan), sigma.mean(axis=(1, 3))


def climb(
    target: Any, values: np.ndarray, gradient: str = "exact", rng: np.random.Generator | None = None
) -> np.ndarray:
    """Return values (P,) of a SceneTarget, at least as probable as those given: ends of ascents, judged by the target.

    All unknowns are `cooled`. The ascents then move contact and shape numbers on the antialiased image under uniform
    priors in the target's ranges; the target's own density decides, so neither approximation can make things worse.
    """
    rng = np.random.default_rng(0) if rng is None else rng
    space, best = target.space, cooled(rng, target, values)
    chosen, ranges = [], {}
    for unknown, offset in zip(space.unknowns, space.offsets, strict=False):
        name = unknown.address.partition(".")[0]
        if unknown.distribution.size == 1 and not unknown.distribution.discrete and name not in ("root", "likelihood"):
            chosen.append(int(offset))
            ranges[unknown.address] = unknown.distribution.support
    if not chosen:
        return best
    numbers = target.by_address(best)
    likelihood = {**target.images.values, **{key.removeprefix("likelihood."): value for key, value in numbers.items()}}
    try:
        problem = MapProblem(target.graph(best), list(ranges), target.images.camera, target.images.observed,
                             sigma=likelihood.get("sigma", 0.005), blur=likelihood.get("blur", 0.0),
                             background=likelihood.get("background", 10.0), ranges=ranges,
                             limit=math.inf if target.images.type == "gaussian" else 8.0)  # fmt: skip
    except DerenderError:
        return best
    density = target.log_prior(best) + target.log_likelihood(best)
    starts = np.vstack([problem.values, problem.random_starts(rng, 4)])
    if gradient == "exact":
        found = problem.maximise(starts[:1], explore=False) + problem.maximise(starts)
        ends = [maximum.values for maximum in found]
    else:
        ends = [state for maximum in problem.maximise(starts[:1], gradient, step=0.005) for state in maximum.path]
    for end in ends:
        trial = best.copy()
        trial[chosen] = end
        log_prior = target.log_prior(trial)
        if log_prior > -math.inf:
            value = log_prior + target.log_likelihood(trial)
            if value > density:
                best, density = trial, value
    return best


def cooled(rng: np.random.Generator, target: Any, values: np.ndarray) -> np.ndarray:
    """Return the likeliest values (P,) that a walk from some meets while the likelihood weighs ever more."""
    parts = mixture(target.space, [{"drift": {}}])
    backend, tuning = backend_of(target, parts), first_tuning(target.space, values)
    best, density = np.array(values, np.float64), sum(backend.evaluate(values))
    for cold in COLDER:
        stretch = backend.sweep(rng, best, tuning._replace(temperature=cold), COLD_STEPS * len(parts), 1)
        found = stretch.densities.sum(axis=1)
        if found.max() > density:
            best, density = stretch.values[found.argmax()], found.max()
        tuning = tuning._replace(scale=rescale(tuning.scale, parts, stretch.counts, GAIN))
    return best
