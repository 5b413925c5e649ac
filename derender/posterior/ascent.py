"""Maximum a posteriori estimation of the numbers of a scene graph whose structure is given (A.3, Eqs. 7-9, Figure 5).

Any scene is led to its mode by a walk ever colder (`cooled`); where none of its solids is a mesh, two ways lead on.
`gauss-newton` (the default): Levenberg-Marquardt on the exact Jacobian of the antialiased image. `gradient`: the
paper's steps of fixed length. Both keep every state inside the domain, angles going round their period.

Eq. 7-9: a contact's parameter moves the vertex and all that descends from it by one rigid motion. The motions are found
by central differences of Eq. 1 itself (numbers of order one in float64: exact to 1e-9), so that every contact type,
slack, and the way sizes enter through (u, v) need no derivative of their own. The image's derivative is exact and never
differenced.

The free numbers of a scene graph become placed solids and their motions in compiled code, as do the images and their
derivatives; the few steps on the way are not compiled.
"""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from derender.compilation.cache import njit
from derender.errors import DerenderError
from derender.posterior.compiled.backend import backend_of
from derender.posterior.compiled.evaluate import place as place_vertex
from derender.posterior.compiled.model import NotCompiled, numbers_of, vertices_of
from derender.posterior.compiled.prior import NEXT, SHAPES, SIZES, SOLID
from derender.posterior.kernels.base import first_tuning, mixture, rescale
from derender.registry import suggest
from derender.render.blur import blur_taps
from derender.render.raycast.normal_equations import MOTION, Misfit, cost, new_misfit, normal_equations
from derender.scene.graph import SceneGraph
from derender.scene.shapes import shapes
from derender.scene.solids import MESH

if TYPE_CHECKING:
    from derender.camera.intrinsics import Camera


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


class Placement(NamedTuple):
    """A graph as arrays, and where its free numbers go. N vertices, P free numbers.

    vertex, slot : (P,) int64, row and column of `numbers` that a free number goes to.
    """

    vertices: np.ndarray  # as in Model
    extents: np.ndarray  # as in Model
    numbers: np.ndarray  # as in Chain (`compiled/prior.py`)
    pose: np.ndarray  # as in Chain (`compiled/prior.py`)
    relative: np.ndarray  # as in Chain (`compiled/prior.py`)
    vertex: np.ndarray
    slot: np.ndarray


def new_placement(graph: SceneGraph, addresses: Sequence[str]) -> tuple[Placement, np.ndarray, Domain]:
    """Return the graph's arrays, the present values of the free numbers, and their domain.

    addresses : such as "red.contact.theta", "red.side".

    Raises DerenderError for an address that is not there or a contact or shape that has no compiled form.
    """
    try:
        vertices, extents = vertices_of(graph)
    except NotCompiled as what:
        raise DerenderError(f"{what} has no compiled form", remedy="use --method mcmc") from None
    names, count = graph.names, len(graph.vertices)
    numbers, pose = np.tile(numbers_of(graph), (2, 1, 1)), np.tile(np.eye(4), (2, count + 1, 1, 1))
    pose[:, count] = graph.root_pose
    vertex_of, slot = np.zeros((2, len(addresses)), np.int64)
    lower, upper, period = np.zeros((3, len(addresses)))
    for p, address in enumerate(addresses):
        name, _, rest = address.partition(".")
        if name not in names:
            raise DerenderError(f"no number is called {address!r}", remedy=suggest(name, names))
        n = vertex_of[p] = names.index(name)
        vertex, of_contact = graph.vertices[n], rest.startswith("contact.")
        known = graph.contact_parameters(name) if of_contact else shapes[vertex.shape].parameters
        wanted = rest.removeprefix("contact.")
        found = [k for k, parameter in enumerate(known) if parameter.name == wanted]
        if not found:
            raise DerenderError(f"no number is called {address!r}", remedy=suggest(wanted, [q.name for q in known]))
        parameter = known[found[0]]
        slot[p] = found[0] + (0 if of_contact else SHAPES)
        period[p] = parameter.period or 0.0
        lower[p], upper[p] = (0.0, period[p]) if parameter.period else (parameter.lower, parameter.upper)
        if not of_contact:
            lower[p] = max(lower[p], SMALLEST / max(extents[n, found[0] + 1].max(), 1e-9))
    placement = Placement(vertices, extents, numbers, pose, np.eye(4), vertex_of, slot)
    return placement, numbers[NEXT, vertex_of, slot], Domain(lower, upper, period)


@njit(cache=True, nogil=True)
def place(placement, values, poses, sizes):
    """Write the poses (S, 4, 4) and sizes (S, 3) of the solids at these values (P,) of the free numbers."""
    vertices, numbers, pose = placement.vertices, placement.numbers, placement.pose
    for p in range(values.shape[0]):
        numbers[NEXT, placement.vertex[p], placement.slot[p]] = values[p]
    for n in range(placement.extents.shape[0]):
        place_vertex(vertices, placement.extents, numbers, pose, placement.relative, n)
        s = vertices[SOLID, n]
        if s >= 0:
            poses[s] = pose[NEXT, n]
            sizes[s] = numbers[NEXT, n, SIZES:SHAPES]


@njit(cache=True, nogil=True)
def find_motions(placement, values, motions):
    """Write the motion (P, S, MOTION) of every solid per unit of every free number."""
    solids = motions.shape[1]
    trial = values.copy()
    poses, after, before = np.empty((solids, 4, 4)), np.empty((solids, 4, 4)), np.empty((solids, 4, 4))
    sizes, larger, smaller = np.empty((solids, 3)), np.empty((solids, 3)), np.empty((solids, 3))
    place(placement, values, poses, sizes)
    scale = 0.5 / STEP
    for p in range(values.shape[0]):
        trial[p] = values[p] + STEP
        place(placement, trial, after, larger)
        trial[p] = values[p] - STEP
        place(placement, trial, before, smaller)
        trial[p] = values[p]
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
FLAT, SINGULAR = 1e-6, 1e-10  # shares of the largest diagonal element taken for one that is 0, and added to all


@njit(cache=True, nogil=True)
def solve_positive(matrix, vector, held, step):
    """Solve matrix step = -vector on the parameters not held (Cholesky); False if the matrix is not positive."""
    count = vector.shape[0]
    factor = np.zeros((count, count))
    for i in range(count):
        if held[i]:
            factor[i, i] = 1.0
            step[i] = 0.0
            continue
        for j in range(i + 1):
            value = matrix[i, j] if not held[j] else 0.0
            for k in range(j):
                value -= factor[i, k] * factor[j, k]
            if i == j:
                if value <= 0.0:
                    return False
                factor[i, i] = math.sqrt(value)
            else:
                factor[i, j] = value / factor[j, j]
        step[i] = -vector[i]
    for i in range(count):
        for k in range(i):
            step[i] -= factor[i, k] * step[k]
        step[i] /= factor[i, i]
    for i in range(count - 1, -1, -1):
        for k in range(i + 1, count):
            step[i] -= factor[k, i] * step[k]
        step[i] /= factor[i, i]
    return True


@njit(cache=True, nogil=True)
def _costs_at(misfit, placement, places, poses, sizes, costs):
    for n in range(places.shape[0]):
        place(placement, places[n], poses, sizes)
        costs[n] = cost(misfit, poses, sizes)


@njit(cache=True, nogil=True)
def _equations_at(misfit, placement, values, poses, sizes, motions, edges, gradient, hessian):
    find_motions(placement, values, motions)
    normal_equations(misfit, poses, sizes, motions, edges, gradient, hessian)


class Cost:
    """Minus the log likelihood of a structure's numbers, up to a constant, and its derivatives.

    edges : False leaves out the occlusion edges of the derivative: wrong, for comparison.
    """

    def __init__(self, misfit: Misfit, placement: Placement, edges: bool = True) -> None:
        self._arrays, self._edges = (misfit, placement), edges
        count, solids = len(placement.vertex), len(misfit.kinds)
        self._placed = np.empty((solids, 4, 4)), np.empty((solids, 3))
        self._motions = np.empty((count, solids, MOTION))

    def at(self, places: np.ndarray) -> np.ndarray:
        """Return the costs (S,) at places (S, P)."""
        costs = np.empty(len(places))
        _costs_at(*self._arrays, np.ascontiguousarray(places, np.float64), *self._placed, costs)  # type: ignore[call-arg]
        return costs

    def equations(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return gradient (P,) and Gauss-Newton Hessian (P, P) at values (P,), the last at which the cost was asked."""
        gradient, hessian = np.empty(len(values)), np.empty((len(values), len(values)))
        _equations_at(*self._arrays, values, *self._placed, self._motions, self._edges, gradient, hessian)  # type: ignore[call-arg]
        return gradient, hessian

    def differences(self, values: np.ndarray, steps: np.ndarray) -> np.ndarray:
        """Return the gradient (P,) by central differences of these steps (P,): for comparison."""
        costs = self.at(np.concatenate([values + np.diag(steps), values - np.diag(steps)])).reshape(2, -1)
        return (costs[0] - costs[1]) / (2.0 * steps)


class Ascent(NamedTuple):
    """Where an ascent went."""

    path: np.ndarray  # (T + 1, P) the states on the way, from the start in the domain on
    costs: np.ndarray  # (T + 1,) theirs: minus their log densities, up to a constant


def levenberg(cost: Cost, start: np.ndarray, domain: Domain, iterations: int, tolerance: float) -> Ascent:
    """Minimise by Levenberg-Marquardt from `start` (P,), in at most `iterations` steps tried.

    tolerance : nats; a smaller gain ends it.
    """
    values = domain.bring(start)
    value = cost.at(values[None])[0]
    gradient, hessian = cost.equations(values)
    path, costs, damping, step = [values], [value], DAMPING, np.zeros(len(values))
    for _ in range(iterations):
        outward = ((values <= domain.lower) & (gradient > 0.0)) | ((values >= domain.upper) & (gradient < 0.0))
        diagonal = np.diag(hessian)
        largest = max(diagonal.max(), 1e-12)
        damped = hessian + np.diag(damping * np.maximum(diagonal, FLAT * largest) + SINGULAR * largest)
        if not solve_positive(damped, gradient, (domain.period == 0.0) & outward, step):
            damping = max(damping * 10.0, DAMPING)
            continue
        foreseen = -float(step @ (gradient + 0.5 * hessian @ step))
        trial = domain.bring(values + step)
        gained = value - cost.at(trial[None])[0]
        if gained > 0.0:
            values, value = trial, value - gained
            damping = max(damping * (0.1 if gained > 0.5 * foreseen else 0.5), LEAST_DAMPING)
            gradient, hessian = cost.equations(values)
            path.append(values)
            costs.append(value)
            if gained < tolerance:
                break
        elif foreseen < tolerance or damping > MOST_DAMPING:
            break
        else:
            damping = max(damping * 8.0, AFTER_FAILURE)
    return Ascent(np.array(path), np.array(costs))


def fixed_steps(cost: Cost, start: np.ndarray, domain: Domain, iterations: int, length: float,
                difference: float = 0.0) -> Ascent:  # fmt: skip
    """Ascend the log density by steps of fixed length along its gradient in unit coordinates, as in Figure 5.

    Each parameter is measured by its range (an angle by its period), the gradient is normalised: then alpha, `length`,
    is a length. The paper does not say what its alpha multiplies. Of nine readings (the plain gradient with sigma from
    1 cm to 1 m or its mean over pixels, unit length in ranges or in radians, each number by itself) those with unit
    length climb most, nine tenths of the way in 12 steps; plain gradients leap past the top and end below the start;
    none comes within 3 nats in 100 ascents, as steps of fixed length end in a circle about the top.
    difference : 0, or the step of central differences in unit coordinates.
    """
    scale = np.where(domain.period > 0.0, domain.period, np.minimum(domain.upper - domain.lower, 1.0))
    path, costs = [domain.bring(start)], []
    for _ in range(iterations + 1):
        values = path[-1]
        costs.append(cost.at(values[None])[0])
        gradient = scale * (cost.differences(values, difference * scale) if difference else cost.equations(values)[0])
        steepness = np.linalg.norm(gradient)
        if steepness == 0.0:
            break
        path.append(domain.bring(values - length * scale * gradient / steepness))
    return Ascent(np.array(path[: len(costs)]), np.array(costs))


METHODS = ("gauss-newton", "gradient", "finite-difference")  # the last: the second, by a derivative that is not exact
COLDER = tuple(2.0 ** np.arange(0.0, 10.0, 0.5))  # what the likelihood is raised to, one after the other
COLD_STEPS, GAIN = 100, 3.0  # at each, of each block of unknowns; of their scales for a rate wrong by 1
DIFFERENCE = 0.01  # step of finite differences, a share of each parameter's range: about a pixel


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
        self._cost = Cost(fine, self.placement, edges)

    def scene(self, values: np.ndarray) -> SceneGraph:
        """Return the graph with these (P,) values."""
        return self.graph.with_numbers(dict(zip(self.addresses, map(float, values), strict=True)))

    def log_density(self, values: np.ndarray) -> float:
        """Return Eq. 6's log likelihood on the antialiased image."""
        return self._constant - float(self._cost.at(np.atleast_2d(values))[0])

    def slope(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the gradient (P,) of the log density at `values` and its Gauss-Newton precision (P, P)."""
        values = np.array(values, np.float64)
        self._cost.at(values[None])
        gradient, hessian = self._cost.equations(values)
        return -gradient, hessian

    def maximise(
        self,
        start: np.ndarray,
        method: str = "gauss-newton",
        iterations: int = 12,
        step: float = 0.05,
        tolerance: float = 0.5,
    ) -> Ascent:
        """Ascend from values (P,); the costs are minus the log densities.

        method : one of METHODS. iterations : steps, at most. step : alpha of the fixed steps. tolerance : nats.
        """
        if method not in METHODS:
            raise DerenderError(f"no method is called {method!r}", remedy=suggest(method, METHODS))
        if method == "gauss-newton":
            ascent = levenberg(self._cost, np.array(start, np.float64), self.domain, iterations, tolerance)
        else:
            difference = DIFFERENCE if method == "finite-difference" else 0.0
            ascent = fixed_steps(self._cost, start, self.domain, iterations, step, difference)
        return ascent._replace(costs=ascent.costs - self._constant)


def climb(
    target: Any, values: np.ndarray, gradient: str = "exact", rng: np.random.Generator | None = None
) -> np.ndarray:
    """Return values (P,) of a SceneTarget, at least as probable as those given: ends of ascents, judged by the target.

    All unknowns are `cooled`. An ascent then moves contact and shape numbers on the antialiased image under uniform
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
    method = "gauss-newton" if gradient == "exact" else gradient
    for end in problem.maximise(problem.values, method, step=0.005).path:
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
