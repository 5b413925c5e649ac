"""Forces at contact points that hold bodies at rest: non-negative least squares over Coulomb's friction cones.

A body is in equilibrium when the wrenches of its contact forces balance its weight. A force at a contact lies in the
cone {f : f.n >= 0, |f - (f.n) n| <= mu f.n}. The conic combination of wrenches that is nearest to the load is found by
the active-set method of Lawson and Hanson (1974) with columns generated where they are needed: given the residual, the
ray of each cone that reduces it fastest is known in closed form, so that the cones are round and not pyramids.

Where the residual is not zero it separates the load from all that the contacts can bear (Farkas' lemma), and tells
how much any other load is out of reach: the margin is found by such cuts.
"""

import math

import numpy as np

from derender.compilation.cache import njit

# A residual below this share of a body's own weight is none: a thousandth of g tilts nothing that matters.
BALANCED = 1e-3
# A ray that is within this cosine of perpendicular to the residual does not reduce it.
STATIONARY = 1e-6
# Columns whose part outside the span of the others is below this square are in it.
DEPENDENT = 1e-12
MOST_MARGIN = 4.0  # g: accelerations beyond it are not looked at
WAYS = 16  # directions around the circle in which a margin is confirmed: it is at most 2 % too great
WITHIN = 2e-3  # share by which that circle is inside the lines that bound it


@njit(cache=True, nogil=True)
def wrench(u, arm, weight, out, start):
    """Write the wrench of the force u at `arm` from a body's centre, in units of its weight, to 6 places of out."""
    out[start] = u[0] / weight
    out[start + 1] = u[1] / weight
    out[start + 2] = u[2] / weight
    out[start + 3] = (arm[1] * u[2] - arm[2] * u[1]) / weight
    out[start + 4] = (arm[2] * u[0] - arm[0] * u[2]) / weight
    out[start + 5] = (arm[0] * u[1] - arm[1] * u[0]) / weight


@njit(cache=True, nogil=True)
def refactored(gram, factor, start, count):
    """Bring the Cholesky factor (K, K) of gram up to date from row `start` on."""
    for k in range(start, count):
        for c in range(k + 1):
            value = gram[k, c]
            for q in range(c):
                value -= factor[k, q] * factor[c, q]
            factor[k, c] = math.sqrt(max(value, DEPENDENT)) if c == k else value / factor[c, c]


@njit(cache=True, nogil=True)
def balance(first, second, arm_1, arm_2, normal, friction, weight, load, memory, rubbing):
    """Return the residual (B, 6) of the load after the nearest combination of contact forces, in units of weights.

    first, second : (P,) indices of the bodies, -1 for one that does not move.
    arm_1, arm_2 : (P, 3) from the centre of mass to the point, over the body's length.
    normal : (P, 3) from the second to the first. friction : (P,). weight : (B,) newtons. load : (B, 6) to be balanced.
    memory : (count (1,), point (K,), ray (K, 3), column (K, 12), value (K,), gram (K, K), factor (K, K)), kept between
        calls with the same contacts: columns found before are where the next one starts.
    rubbing : whether friction counts.
    """
    number, points, rays, columns, values, gram, factor = memory
    bodies, contacts, most = len(weight), len(first), len(points)
    count = number[0]
    residual = np.empty((bodies, 6))
    forward, target, solved = np.empty(most), np.empty(most), 0  # the first `solved` of forward are of this factor
    blocked = np.zeros(contacts, np.bool_)
    scale = math.sqrt(float((load * load).sum()))
    fresh = count > 0  # columns of an earlier call have to be fitted to this load first
    for _ in range(20 * most + 100):
        if not fresh:
            residual[:] = load
            for k in range(count):
                p = points[k]
                for side in range(2):
                    b = first[p] if side == 0 else second[p]
                    if b >= 0:
                        for q in range(6):
                            residual[b, q] -= columns[k, 6 * side + q] * values[k]
            size = math.sqrt(float((residual * residual).sum()))
            if size < 0.1 * BALANCED or count == most:
                break
            best, chosen = STATIONARY * max(size, 1e-3 * scale), -1
            ray = np.zeros(3)
            for p in range(contacts):
                if blocked[p]:
                    continue
                a0, a1, a2, length = 0.0, 0.0, 0.0, 0.0
                for side in range(2):
                    b, arm = (first[p], arm_1) if side == 0 else (second[p], arm_2)
                    if b < 0:
                        continue
                    x, y, z = arm[p, 0], arm[p, 1], arm[p, 2]
                    w = (1.0 if side == 0 else -1.0) / weight[b]
                    a0 += w * (residual[b, 0] + residual[b, 4] * z - residual[b, 5] * y)
                    a1 += w * (residual[b, 1] + residual[b, 5] * x - residual[b, 3] * z)
                    a2 += w * (residual[b, 2] + residual[b, 3] * y - residual[b, 4] * x)
                    length += w * w * (1.0 + x * x + y * y + z * z)
                n0, n1, n2 = normal[p, 0], normal[p, 1], normal[p, 2]
                along = a0 * n0 + a1 * n1 + a2 * n2
                t0, t1, t2 = a0 - along * n0, a1 - along * n1, a2 - along * n2
                slide = math.sqrt(t0 * t0 + t1 * t1 + t2 * t2)
                mu = friction[p] if rubbing else 0.0
                gain = (along + mu * slide) / math.sqrt(length * (1.0 + mu * mu))
                if gain > best:
                    best, chosen = gain, p
                    share = mu / slide if slide > 1e-12 * scale else 0.0
                    ray[0], ray[1], ray[2] = n0 + share * t0, n1 + share * t1, n2 + share * t2
            if chosen < 0:
                break
            column = columns[count]
            column[:] = 0.0
            if first[chosen] >= 0:
                wrench(ray, arm_1[chosen], weight[first[chosen]], column, 0)
            if second[chosen] >= 0:
                wrench(-ray, arm_2[chosen], weight[second[chosen]], column, 6)
            norm = math.sqrt(float((column * column).sum()))
            column /= norm
            points[count] = chosen
            rays[count] = ray / norm
            for k in range(count + 1):
                value = 0.0
                for side in range(2):
                    b = first[chosen] if side == 0 else second[chosen]
                    if b < 0:
                        continue
                    for other in range(2):
                        if (first[points[k]] if other == 0 else second[points[k]]) == b:
                            for q in range(6):
                                value += columns[count, 6 * side + q] * columns[k, 6 * other + q]
                gram[count, k] = gram[k, count] = value
            values[count] = 0.0
            refactored(gram, factor, count, count + 1)
            if factor[count, count] ** 2 <= 2 * DEPENDENT:
                blocked[chosen] = True
                continue
            count += 1
        fresh = False
        while count > 0:
            for k in range(solved, count):
                p = points[k]
                value = 0.0
                for side in range(2):
                    b = first[p] if side == 0 else second[p]
                    if b >= 0:
                        for q in range(6):
                            value += columns[k, 6 * side + q] * load[b, q]
                for q in range(k):
                    value -= factor[k, q] * forward[q]
                forward[k] = value / factor[k, k]
            solved = count
            target[:count] = forward[:count]
            for k in range(count - 1, -1, -1):
                target[k] /= factor[k, k]
                for q in range(k):
                    target[q] -= factor[k, q] * target[k]
            step, worst = 1.0, -1
            for k in range(count):
                if target[k] <= 0.0:
                    share = values[k] / max(values[k] - target[k], 1e-300)
                    if share < step or worst < 0:
                        step, worst = share, k
            if worst < 0:
                values[:count] = target[:count]
                break
            kept, start = 0, -1
            for k in range(count):
                value = values[k] + step * (target[k] - values[k])
                if k == worst or value <= 1e-14:
                    if start < 0:
                        start = k
                    continue
                if kept != k:
                    points[kept], rays[kept], columns[kept] = points[k], rays[k], columns[k]
                    gram[kept, :count] = gram[k, :count]
                    gram[:count, kept] = gram[:count, k]
                values[kept] = value
                kept += 1
            count, solved = kept, start
            refactored(gram, factor, start, count)
    number[0] = count
    return residual


@njit(cache=True, nogil=True)
def greatest(residual):
    """Return the greatest norm of a body's residual (B, 6), a float."""
    most = 0.0
    for b in range(residual.shape[0]):
        total = 0.0
        for q in range(residual.shape[1]):
            total += residual[b, q] * residual[b, q]
        most = max(most, total)
    return math.sqrt(most)


def new_memory(bodies: int, contacts: int) -> tuple[np.ndarray, ...]:
    """Return an empty memory for `balance`."""
    most = min(6 * bodies, 3 * contacts) + 2
    return (
        np.zeros(1, np.int64), np.zeros(most, np.int64), np.zeros((most, 3)), np.zeros((most, 12)), np.zeros(most),
        np.zeros((most, most)), np.zeros((most, most)),
    )  # fmt: skip


def equilibrium(parts: tuple[np.ndarray, ...], load: np.ndarray) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
    """Return the residual (B, 6) and the memory: normal forces alone first, then friction too.

    parts : (first, second, arm_1, arm_2, normal, friction, weight) of `balance`.
    """
    memory = new_memory(len(load), len(parts[0]))
    residual = balance(*parts, load, memory, False)
    if greatest(residual) > BALANCED:
        residual = balance(*parts, load, memory, True)
    return residual, memory


def least_push(
    parts: tuple[np.ndarray, ...], load: np.ndarray, memory: tuple[np.ndarray, ...], across: np.ndarray, most: float
) -> tuple[float, np.ndarray]:
    """Return the least horizontal acceleration, in g, that the contacts cannot bear, and its direction (3,).

    The accelerations that can be borne are a convex set in the horizontal plane. One outside it gives a straight line
    that the set does not cross; the margin is the distance of the nearest such line from the origin, once WAYS
    accelerations around a circle of this radius are inside: it is at most a share 1 - cos(pi / WAYS) too great.

    across : (2, 3) horizontal unit vectors. most : g, beyond which accelerations are not looked at.
    """
    radius, least = most, across[0]
    for turn in 2.0 * math.pi * np.arange(WAYS) / WAYS:
        way = math.cos(turn) * across[0] + math.sin(turn) * across[1]
        # The set is convex: directions that passed further out pass nearer in, so only this one is looked at again.
        while radius > BALANCED:
            reach = radius * (1.0 - WITHIN)
            trial = load.copy()
            trial[:, :3] += reach * way
            residual = balance(*parts, trial, memory, True)
            if greatest(residual) <= BALANCED:
                break
            slope = across @ residual[:, :3].sum(axis=0)
            steep = float(np.hypot(*slope))
            cut = max(-float((residual * load).sum()), 0.0) / steep if steep > 0 else 0.0
            if cut < radius and steep > 0:
                least = slope @ across / steep
            # what failed is outside, even where rounding spoils the line
            radius = min(cut, reach)
    return radius, least
