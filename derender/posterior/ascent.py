"""Maximum a posteriori estimation of the numbers of a scene graph whose structure is given (A.3, Eqs. 7-9, Figure 5).

Any scene is led to its mode by a walk ever colder (`cooled`); where none of its solids is a mesh, Levenberg-Marquardt
on the Jacobian of the antialiased image leads on, along its exact gradient or along that of finite differences. It
keeps every state inside the domain, angles going round their period.

Eq. 7-9: a contact's parameter moves the vertex and all that descends from it by one rigid motion. The motions are found
by central differences of Eq. 1 itself (numbers of order one in float64: exact to 1e-9), so that every contact type,
slack, and the way sizes enter through (u, v) need no derivative of their own. The image's derivative is exact and never
differenced.

The numbers of a scene graph become placed solids and their motions by the code that chains walk with, as compiled as
the images and their derivatives; the few steps on the way are not.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from derender.compilation.cache import njit
from derender.errors import DerenderError
from derender.posterior.compiled.backend import backend_of
from derender.posterior.compiled.evaluate import put_all
from derender.posterior.compiled.model import NotCompiled, chain_of, model_of
from derender.posterior.kernels.base import first_tuning, mixture
from derender.posterior.target import SceneTarget
from derender.render.blur import blur_taps
from derender.render.raycast.normal_equations import MOTION, cost, new_misfit, normal_equations
from derender.sampling.descent import NO_LIMITS, damped_step
from derender.scene.solids import MESH


class Domain(NamedTuple):
    """Where parameters may be."""

    lower: np.ndarray  # (P,) float64
    upper: np.ndarray  # (P,) float64
    period: np.ndarray  # (P,) float64, 0 = none, else they are 0 and this

    def bring(self, values: np.ndarray) -> np.ndarray:
        """Return the nearest values inside."""
        around = self.period > 0.0
        period = np.where(around, self.period, 1.0)
        turned = values - period * np.floor(values / period)
        return np.where(around, turned, np.clip(values, self.lower, self.upper))


STEP = 1e-6  # of the differences: metres, radians, or shares
SMALLEST = 1e-3  # metres: no extent is moved below this


@njit(cache=True, nogil=True)
def find_motions(model, chain, values, chosen, motions):
    """Write the motion (n, S, MOTION) of every solid per unit of each of the values (P,) that are chosen (n,)."""
    solids, trial = motions.shape[1], values.copy()
    put_all(model, chain, values)
    poses = chain.moved_pose.copy()
    scale = 0.5 / STEP
    for p in range(len(chosen)):
        trial[chosen[p]] = values[chosen[p]] + STEP
        put_all(model, chain, trial)
        after, larger = chain.moved_pose.copy(), chain.moved_size.copy()
        trial[chosen[p]] = values[chosen[p]] - STEP
        put_all(model, chain, trial)
        before, smaller = chain.moved_pose, chain.moved_size
        trial[chosen[p]] = values[chosen[p]]
        for k in range(solids):
            motion = motions[p, k]
            turn = np.zeros((3, 3))
            moved = False
            for i in range(3):
                for j in range(4):
                    if after[k, i, j] != before[k, i, j]:
                        moved = True
                motion[6 + i] = (larger[k, i] - smaller[k, i]) * scale
            motion[:6] = 0.0
            if not moved:
                continue
            for i in range(3):
                for j in range(3):
                    for c in range(3):
                        turn[i, j] += (after[k, i, c] - before[k, i, c]) * scale * poses[k, j, c]
            motion[3] = 0.5 * (turn[2, 1] - turn[1, 2])
            motion[4] = 0.5 * (turn[0, 2] - turn[2, 0])
            motion[5] = 0.5 * (turn[1, 0] - turn[0, 1])
            x, y, z = poses[k, 0, 3], poses[k, 1, 3], poses[k, 2, 3]
            motion[0] = (after[k, 0, 3] - before[k, 0, 3]) * scale - (motion[4] * z - motion[5] * y)
            motion[1] = (after[k, 1, 3] - before[k, 1, 3]) * scale - (motion[5] * x - motion[3] * z)
            motion[2] = (after[k, 2, 3] - before[k, 2, 3]) * scale - (motion[3] * y - motion[4] * x)
            for c in range(MOTION):
                if abs(motion[c]) < 1e-8:
                    motion[c] = 0.0


DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-3, 1e-7, 1e6  # of the Hessian's diagonal: at the start, and its limits
AFTER_FAILURE = 1e-2  # least damping after a step that did not lower the cost: smaller ones would fail again


@njit(cache=True, nogil=True)
def _cost_at(misfit, model, chain, values, chosen, place):
    for p in range(len(chosen)):
        values[chosen[p]] = place[p]
    put_all(model, chain, values)
    return cost(misfit, chain.moved_pose, chain.moved_size)


@njit(cache=True, nogil=True)
def _equations_at(misfit, model, chain, values, chosen, edges, motions, gradient, hessian):
    find_motions(model, chain, values, chosen, motions)
    put_all(model, chain, values)
    normal_equations(misfit, chain.moved_pose, chain.moved_size, motions, edges, gradient, hessian)


class Ascent(NamedTuple):
    """Where an ascent went."""

    path: np.ndarray  # (T + 1, P) the states on the way, from the start in the domain on
    densities: np.ndarray  # (T + 1,) their logs


COLDER = tuple(2.0 ** np.arange(0.0, 10.0, 0.5))  # what the likelihood is raised to, one after the other
ROBUST = 8.0  # nats at which a pixel counts as an outlier, where some may be
DIFFERENCE = 0.01  # step of finite differences, a share of each parameter's range: about a pixel
COLD_STEPS, GAIN = 100, 0.1  # at each, of each block of unknowns; of their scales, at each step


class MapProblem:
    """The posterior density of a scene's contact and shape numbers given its image, antialiased, and a way to its top.

    target : SceneTarget. values : (P,), at which all other numbers are held. Priors are taken as uniform where they are
        not zero; the likelihood as normal, or as robust where the target's is any other.
    gradient : "exact", or "finite-difference": by central differences of steps of DIFFERENCE, precision exact.
    edges : False leaves out the occlusion edges of the derivative: wrong, for comparison.

    places : (n,) numbers of the unknowns, and where these begin among the values; start : (n,) their present values.

    Raises DerenderError : something of the scene has no compiled form or no exact derivative, or nothing can move.
    """

    def __init__(self, target: SceneTarget, values: np.ndarray, gradient: str = "exact", edges: bool = True) -> None:
        self.target, self.values, space = target, np.array(values, np.float64), target.space
        moving = [(unknown, int(offset)) for unknown, offset in zip(space.unknowns, space.offsets, strict=False)
                  if unknown.distribution.size == 1 and not unknown.distribution.discrete
                  and unknown.address.partition(".")[0] not in ("root", "likelihood")]  # fmt: skip
        solids = target.graph(self.values).solids()
        try:
            model, chain = model_of(target), chain_of(target)
        except NotCompiled as what:
            raise DerenderError(f"{what} has no compiled form", remedy="use --method mcmc") from None
        if not moving or (solids.kind == MESH).any():
            raise DerenderError("meshes have no exact derivative", remedy="give boxes, cubes, cylinders or spheres")
        self.chosen = np.array([offset for _, offset in moving])
        self.start, supports = self.values[self.chosen], [unknown.distribution.support for unknown, _ in moving]
        least = [-math.inf if ".contact." in unknown.address else SMALLEST for unknown, _ in moving]
        lower, upper = np.maximum(np.array(supports)[:, 0], least), np.array(supports)[:, 1]
        self.domain = Domain(lower, upper, np.array([unknown.period or 0.0 for unknown, _ in moving]))
        images = target.images
        numbers, observed = {**images.values, **target.of_likelihood(values)}, images.observed
        seen, sigma = np.isfinite(observed) & (observed > 0), numbers.get("sigma", 0.005)
        self._constant = -float(np.sum(seen)) * (math.log(sigma) + 0.5 * math.log(2 * math.pi))
        limit = math.inf if images.type == "gaussian" else ROBUST
        fine = new_misfit(images.camera, observed, sigma, solids.kind, len(moving),
                          blur_taps(numbers.get("blur", 0.0)), numbers.get("background", 10.0), limit)  # fmt: skip
        reach = np.where(self.domain.period > 0.0, self.domain.period, np.minimum(upper - lower, 1.0))
        self._steps = None if gradient == "exact" else np.diag(DIFFERENCE * reach)
        self._arrays, self._edges = (fine, model, chain, self.values.copy(), self.chosen), edges

    def at(self, place: np.ndarray) -> np.ndarray:
        """Return all values (P,) with these (n,) that move."""
        values = self.values.copy()
        values[self.chosen] = place
        return values

    def log_density(self, place: np.ndarray) -> float:
        """Return Eq. 6's log likelihood on the antialiased image."""
        return self._constant - _cost_at(*self._arrays, np.asarray(place, np.float64))  # type: ignore[call-arg]

    def slope(self, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the gradient (n,) of the log density at a place (n,) and its Gauss-Newton precision (n, n)."""
        self.log_density(place)
        count, solids = len(self.chosen), len(self._arrays[0].kinds)
        motions, gradient, hessian = np.empty((count, solids, MOTION)), np.empty(count), np.empty((count, count))
        _equations_at(*self._arrays, self._edges, motions, gradient, hessian)  # type: ignore[call-arg]
        if self._steps is None:
            return -gradient, hessian
        gains = [self.log_density(place + step) - self.log_density(place - step) for step in self._steps]
        return np.array(gains) / (2.0 * np.diag(self._steps)), hessian

    def maximise(self, start: np.ndarray, iterations: int = 12, tolerance: float = 0.5) -> Ascent:
        """Ascend from values (n,) by Levenberg-Marquardt, in at most `iterations` steps tried.

        tolerance : nats; a smaller gain ends it.
        """
        domain, damping = self.domain, DAMPING
        values = domain.bring(np.array(start, np.float64))
        density, (gradient, precision) = self.log_density(values), self.slope(values)
        path, densities, step = [values], [density], np.zeros(len(values))
        for _ in range(iterations):
            outward = ((values <= domain.lower) & (gradient < 0.0)) | ((values >= domain.upper) & (gradient > 0.0))
            foreseen = damped_step(precision, -gradient, damping, (domain.period == 0.0) & outward, NO_LIMITS, step)
            if math.isnan(foreseen):
                damping = max(damping * 10.0, DAMPING)
                continue
            trial = domain.bring(values + step)
            gained = self.log_density(trial) - density
            if gained > 0.0:
                values, density = trial, density + gained
                damping = max(damping * (0.1 if gained > 0.5 * foreseen else 0.5), LEAST_DAMPING)
                gradient, precision = self.slope(values)
                path.append(values)
                densities.append(density)
                if gained < tolerance:
                    break
            elif foreseen < tolerance or damping > MOST_DAMPING:
                break
            else:
                damping = max(damping * 8.0, AFTER_FAILURE)
        return Ascent(np.array(path), np.array(densities))


def climb(
    target: Any, values: np.ndarray, gradient: str = "exact", rng: np.random.Generator | None = None
) -> np.ndarray:
    """Return values (P,) of a SceneTarget, at least as probable as those given: ends of ascents, judged by the target.

    All unknowns are `cooled`. An ascent then moves contact and shape numbers on the antialiased image under uniform
    priors in the target's ranges; the target's own density decides, so neither approximation can make things worse.
    """
    best = cooled(np.random.default_rng(0) if rng is None else rng, target, values)
    try:
        problem = MapProblem(target, best, gradient)
    except DerenderError:
        return best
    density = target.log_prior(best) + target.log_likelihood(best)
    for end in problem.maximise(problem.start).path:
        trial = problem.at(end)
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
        stretch = backend.sweep(rng, best, tuning._replace(temperature=cold), COLD_STEPS * len(parts), 1, GAIN)
        found = stretch.densities.sum(axis=1)
        if found.max() > density:
            best, density = stretch.values[found.argmax()], found.max()
        tuning = tuning._replace(scale=stretch.scale)
    return best
