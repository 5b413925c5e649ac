"""A step of a kernel on a scene: propose, see what moves and where it stands then (Eq. 1), ask the engine, settle.

One source, which numba compiles or Python runs. The engine is called from one place only, since whatever a compiled
function calls is compiled into it again.

Objects that are put down in the world take the contacts that leave their children where they are.
"""

import math
from collections.abc import Callable

import numpy as np

from derender.compilation.cache import call_for_nothing, call_for_number, call_for_two_numbers, njit
from derender.posterior.compiled.prior import (
    CHILD_FACE,
    CONTACT,
    CONTACT_CODE,
    DIRTY,
    FACTOR_FIRST,
    FIRST,
    FOLD_CENTRE,
    FOLD_PERIOD,
    FORM,
    INVERSE_AT,
    KEEP,
    KEEP_AT,
    KEPT,
    KIND,
    LIKELIHOOD,
    MOVED,
    NEXT,
    NOW,
    OWNER,
    PARENT,
    PARENT_FACE,
    PENDING,
    PLACE_AT,
    POSE_AT,
    PROPOSE_AT,
    ROOT,
    SHAPE,
    SHAPES,
    SIZES,
    SLOT,
    SOLID,
    TABLE,
    VERTEX,
    Chain,
    Model,
    log_prior,
    log_terms,
    wrap,
)
from derender.posterior.kernels.base import PLACING
from derender.render.raycast.engine import load_state, log_likelihood_of, propose_in, settle_in
from derender.render.raycast.state import CANDIDATE, CURRENT, GAUSSIAN, SIGMA, WHOLE, EngineState, take_blur
from derender.render.raycast.state import LIKELIHOOD as TYPE
from derender.sampling.metropolis import DENSITY, PRIOR
from derender.scene.contacts.compiled import SIX_DOF, outline
from derender.scene.polygon import area_element
from derender.scene.pose import compose, copy_placed
from derender.scene.solids import PLANE

FREE_ROOT, FIXED_ROOT, LOOKED_AT = SIX_DOF, 100, 101  # codes of the root
BLURRING = -1  # slot of a likelihood's blur, which is none of the engine's parameters


@njit(cache=True, nogil=True)
def place_root(vertices, numbers, pose):
    """Write the proposed pose of the root, which is the last vertex; a fixed one is there already."""
    root = vertices.shape[1] - 1
    code, values, out = vertices[CONTACT_CODE, root], numbers[NEXT, root], pose[NEXT, root]
    if code == FREE_ROOT:  # the same as a free contact: x, y, z, qw, qx, qy, qz
        size = values[SIZES:SHAPES]
        call_for_nothing(vertices[POSE_AT, root], SIX_DOF, vertices[KIND, root], size, vertices[KIND, root], size,
                         vertices[PARENT_FACE, root], vertices[CHILD_FACE, root], values, out)  # fmt: skip
    elif code == LOOKED_AT:  # Rz(roll) T(0, 0, distance) Rx(pi / 2 + elevation) Rz(azimuth)
        c, s = math.cos(math.pi / 2 + values[1]), math.sin(math.pi / 2 + values[1])
        cz, sz = math.cos(values[2]), math.sin(values[2])
        cr, sr = math.cos(values[3]), math.sin(values[3])
        out[0, 0], out[0, 1], out[0, 2] = cr * cz - sr * c * sz, -cr * sz - sr * c * cz, sr * s
        out[1, 0], out[1, 1], out[1, 2] = sr * cz + cr * c * sz, -sr * sz + cr * c * cz, -cr * s
        out[2, 0], out[2, 1], out[2, 2] = s * sz, s * cz, c
        out[0, 3], out[1, 3], out[2, 3] = 0.0, 0.0, values[0]


@njit(cache=True, nogil=True)
def seen_from(frame, pose, out):
    """Write the (4, 4) pose in the axes of a frame, frame^-1 pose, into the first three rows of `out`."""
    for i in range(3):
        for j in range(4):
            total = 0.0
            for k in range(3):
                total += frame[k, i] * (pose[k, j] - (frame[k, 3] if j == 3 else 0.0))
            out[i, j] = total


@njit(cache=True, nogil=True)
def place(vertices, extents, numbers, pose, relative, n):
    """Write the proposed extents and pose of vertex n; its parent's are there."""
    parent = vertices[PARENT, n]
    own = numbers[NEXT, n]
    for i in range(3):
        size = extents[n, 0, i]
        for j in range(3):
            size += extents[n, j + 1, i] * own[SHAPES + j]
        own[SIZES + i] = size
    call_for_nothing(vertices[POSE_AT, n], vertices[CONTACT_CODE, n], vertices[KIND, parent],
                     numbers[NEXT, parent, SIZES:SHAPES], vertices[KIND, n], own[SIZES:SHAPES],
                     vertices[PARENT_FACE, n], vertices[CHILD_FACE, n], own, relative)  # fmt: skip
    compose(pose[NEXT, parent], relative, pose[NEXT, n])


@njit(cache=True, nogil=True)
def fill(places, values, numbers, marks, everything):
    """Put the proposed values that differ from the current ones (or all) where they belong; mark what they move."""
    root = marks.shape[1] - 1
    for p in range(places.shape[1]):
        value = values[NEXT, p]
        if everything or value != values[NOW, p]:
            table, vertex, slot = places[TABLE, p], places[VERTEX, p], places[SLOT, p]
            if table == ROOT:
                numbers[NEXT, root, slot] = value
                marks[DIRTY, root] = 1
            elif table == CONTACT or table == SHAPE:
                numbers[NEXT, vertex, slot if table == CONTACT else SHAPES + slot] = value
                if not marks[KEPT, vertex]:
                    marks[DIRTY, vertex] = 1


@njit(cache=True, nogil=True)
def tell_likelihood(places, values, half, engine, everything):
    """Give the engine the likelihood's numbers of one half where they differ from the other's (or all); return whether
    every pixel has to be scored anew."""
    whole = False
    for p in range(places.shape[1]):
        if places[TABLE, p] == LIKELIHOOD and (everything or values[NEXT, p] != values[NOW, p]):
            slot = places[SLOT, p]
            if slot == BLURRING:
                take_blur(engine.settings, engine.taps, values[half, p])
            else:
                engine.parameters[slot] = values[half, p]
            whole |= slot != SIGMA or engine.settings[TYPE] != GAUSSIAN
    return whole


@njit(cache=True, nogil=True)
def arrange(vertices, extents, numbers, pose, marks, relative, moved_pose, moved_size):
    """Place what the marked vertices move; list the solids that have to be drawn anew and return how many."""
    root = vertices.shape[1] - 1
    if marks[DIRTY, root]:
        place_root(vertices, numbers, pose)
    moved = 0
    for n in range(root):
        if not marks[KEPT, n] and (marks[DIRTY, n] or marks[DIRTY, vertices[PARENT, n]]):
            marks[DIRTY, n] = 1
            place(vertices, extents, numbers, pose, relative, n)
            if vertices[SOLID, n] >= 0:
                marks[MOVED, moved] = vertices[SOLID, n]
                copy_placed(pose[NEXT, n], numbers[NEXT, n, SIZES:SHAPES], moved_pose[moved], moved_size[moved])
                moved += 1
    return moved


@njit(cache=True, nogil=True)
def evaluate(model, chain, engine):
    """Write log prior and log likelihood of the proposed values beside them; `settle` must follow.

    Only what differs from the current values is placed and drawn anew.
    """
    values = chain.values
    values[NEXT, PRIOR] = log_prior(model.unknowns, model.laws, values[NEXT])
    values[NEXT, DENSITY] = -math.inf
    if values[NEXT, PRIOR] == -math.inf:
        return
    fill(model.places, values, chain.numbers, chain.marks, False)
    moved = arrange(model.vertices, model.extents, chain.numbers, chain.pose, chain.marks, chain.relative,
                    chain.moved_pose, chain.moved_size)  # fmt: skip
    values[NEXT, PRIOR] += log_terms(model, chain)
    if values[NEXT, PRIOR] == -math.inf:
        return
    whole = tell_likelihood(model.places, values, NEXT, engine, False)
    if moved or whole:
        engine.settings[WHOLE] = whole
        values[NEXT, DENSITY] = propose_in(engine, moved, chain.marks[MOVED], chain.moved_pose, chain.moved_size)
        chain.flags[PENDING] = 1
    else:
        values[NEXT, DENSITY] = log_likelihood_of(engine, engine.total[CURRENT])


@njit(cache=True, nogil=True)
def copy_marked(numbers, pose, marks, source):
    """Bring the other half up to `source` where vertices are marked, and take the marks away."""
    target = 1 - source
    for n in range(marks.shape[1]):
        if marks[DIRTY, n] or marks[KEPT, n]:
            marks[DIRTY, n] = marks[KEPT, n] = 0
            for i in range(numbers.shape[2]):
                numbers[target, n, i] = numbers[source, n, i]
            for i in range(3):
                for j in range(4):
                    pose[target, n, i, j] = pose[source, n, i, j]


@njit(cache=True, nogil=True)
def settle(target, accepted):
    """Make the proposed values of a Target the current ones, or forget them."""
    model, _, chain, engine = target
    values = chain.values
    if chain.flags[PENDING]:
        settle_in(engine, CANDIDATE if accepted else CURRENT)
        chain.flags[PENDING] = 0
    source = NEXT if accepted else NOW
    if not accepted:
        tell_likelihood(model.places, values, NOW, engine, False)
    copy_marked(chain.numbers, chain.pose, chain.marks, source)
    for p in range(values.shape[1]):
        values[1 - source, p] = values[source, p]


@njit(cache=True, nogil=True)
def put_all(model, chain, start):
    """Make `start` (P,) the current values without their densities: every vertex is placed."""
    values, marks = chain.values, chain.marks
    for p in range(len(start)):
        values[NEXT, p] = start[p]
    chain.flags[PENDING] = 0
    fill(model.places, values, chain.numbers, marks, True)
    marks[DIRTY, :] = 1
    arrange(model.vertices, model.extents, chain.numbers, chain.pose, marks, chain.relative, chain.moved_pose,
            chain.moved_size)  # fmt: skip
    copy_marked(chain.numbers, chain.pose, marks, NEXT)


@njit(cache=True, nogil=True)
def _log_prior_of_all(model, chain):
    return log_prior(model.unknowns, model.laws, chain.values[NEXT]) + log_terms(model, chain)


def loader(model: Model, chain: Chain, engine: EngineState, start: np.ndarray) -> Callable[..., None]:
    """Return what makes `start` (P,) the current values, in full, for arguments of the types of these; the values must
    lie in the prior's support.

    Not compiled itself: that would compile the engine's full evaluation a second time, for eight seconds.
    """
    put = put_all.bound(model, chain, start)
    tell = tell_likelihood.bound(model.places, chain.values, NEXT, engine, True)
    log_prior_of = _log_prior_of_all.bound(model, chain)
    draw = load_state.bound(engine, chain.moved_pose, chain.moved_size)

    def load(model: Model, chain: Chain, engine: EngineState, start: np.ndarray) -> None:
        put(model, chain, start)
        values = chain.values
        tell(model.places, values, NEXT, engine, True)
        values[NEXT, PRIOR] = log_prior_of(model, chain)
        values[NEXT, DENSITY] = draw(engine, chain.moved_pose, chain.moved_size)  # solids are in vertex order
        values[NOW] = values[NEXT]

    return load


ELSEWHERE = -1  # form of a kernel whose steps the caller takes


@njit(cache=True, nogil=True)
def attempt(rng, target, k, scale, temperature):
    """Return the log ratio of a step of kernel k on a Target, NaN where the caller has to take it; `settle` it then."""
    model, kernels, chain, engine = target
    laws, values, form = model.laws, chain.values, kernels.table[FORM, k]
    if form == ELSEWHERE:
        return math.nan
    members = kernels.members[kernels.table[FIRST, k] : kernels.table[FIRST, k + 1]]
    factor = kernels.factors[kernels.table[FACTOR_FIRST, k] : kernels.table[FACTOR_FIRST, k + 1]]
    keep = kernels.table[KEEP, k]
    if form == PLACING:
        correction = call_for_number(
            kernels.table[PLACE_AT, k], rng, model.vertices, laws, chain.numbers, chain.pose, chain.relative,
            chain.moved_pose[0], members, factor, kernels.table[PROPOSE_AT, k]
        )  # fmt: skip
    else:
        correction = call_for_number(
            kernels.table[PROPOSE_AT, k], rng, model.unknowns, laws, values, chain.tangents, members, factor,
            kernels.reach[k] * scale
        )  # fmt: skip
    if keep >= 0 and not math.isnan(correction):
        correction += call_for_number(
            kernels.table[KEEP_AT, k], model.vertices, model.extents, model.places, laws, values, chain.numbers,
            chain.pose, chain.marks, chain.relative, keep, form == PLACING, chain.moved_pose[0]
        )  # fmt: skip
    if math.isnan(correction):
        return -math.inf
    evaluate(model, chain, engine)
    if values[NEXT, PRIOR] == -math.inf:
        return -math.inf
    log_ratio = values[NEXT, PRIOR] - values[NOW, PRIOR] + correction
    return log_ratio + temperature * (values[NEXT, DENSITY] - values[NOW, DENSITY])


NEAR = 1e-7  # slack that rounding may leave


@njit(cache=True, nogil=True)
def fold(angle, centre, period):
    """Return the angle by whole periods into [centre - period / 2, centre + period / 2)."""
    return wrap(angle - centre + 0.5 * period, period) + centre - 0.5 * period


@njit(cache=True, nogil=True)
def reattach(vertices, extents, places, laws, values, numbers, pose, marks, scratch, n, put, there):
    """Write the proposed values of vertices from n on such that all after n stand as they do now.

    put : whether n shall stand `there`, (4, 4); else its proposed values say where it stands.

    Returns the log of the product of |d phi' / d phi| at fixed motion in the world (see SceneTarget), NaN where one
    would leave its contact.
    """
    if not put:
        fill(places, values, numbers, marks, False)
        place(vertices, extents, numbers, pose, scratch, n)
    log_jacobian = 0.0
    for c in range(n + (not put), vertices.shape[1] - 1):
        parent, moves = vertices[PARENT, c], put and c == n
        if not moves and not marks[DIRTY, parent]:  # its axes are as they were
            continue
        seen_from(pose[NEXT, parent], there if moves else pose[NOW, c], scratch)
        own, phi = numbers[NOW, c], numbers[NEXT, c]
        on, by = vertices[PARENT_FACE, c], vertices[CHILD_FACE, c]
        size, child_size = numbers[NEXT, parent, SIZES:SHAPES], own[SIZES:SHAPES]
        marks[DIRTY if moves else KEPT, c] = 1
        outside, angle = call_for_two_numbers(vertices[INVERSE_AT, c], vertices[CONTACT_CODE, c],
                                              vertices[KIND, parent], size, vertices[KIND, c], child_size, on, by,
                                              scratch, phi)  # fmt: skip
        left = max(abs(phi[3] - own[3]), abs(phi[4] - own[4]), abs(phi[5] - own[5]))
        if outside > 1e-9 or angle > NEAR or left > NEAR:
            return math.nan
        phi[3], phi[4], phi[5] = own[3], own[4], own[5]
        for p in range(places.shape[1]):
            if places[VERTEX, p] == c and places[TABLE, p] == CONTACT:
                if places[SLOT, p] == 0:
                    owner = places[OWNER, p]
                    theta = fold(phi[0], laws[owner, FOLD_CENTRE], laws[owner, FOLD_PERIOD])
                    if not moves and abs(fold(phi[0] - theta, 0.0, 2.0 * math.pi)) > 1e-6:
                        marks[KEPT, c], marks[DIRTY, c] = 0, 1
                    phi[0] = theta
                values[NEXT, p] = phi[places[SLOT, p]]
        if marks[DIRTY, c]:
            place(vertices, extents, numbers, pose, scratch, c)
        a, b, radius, _ = outline(vertices[KIND, parent], size, on)
        d, e, child_radius, _ = outline(vertices[KIND, c], child_size, by)
        if a < math.inf and d < math.inf:
            radius += child_radius
            log_jacobian += math.log(area_element(own[1], own[0], a, b, d, e, radius))
            log_jacobian -= math.log(area_element(phi[1], phi[0], a, b, d, e, radius))
    return log_jacobian


UNBOUNDED = np.int64(PLANE)  # the face below is taken for a plane: offsets on it are metres


@njit(cache=True, nogil=True)
def stand(vertices, numbers, pose, relative, base, face, n, phi):
    """Write the contact that vertex n would have on the plane of a face of vertex `base`: angle, x, y, slack."""
    seen_from(pose[NOW, base], pose[NOW, n], relative)
    size, child_size = numbers[NOW, base, SIZES:SHAPES], numbers[NOW, n, SIZES:SHAPES]
    call_for_two_numbers(vertices[INVERSE_AT, n], vertices[CONTACT_CODE, n], UNBOUNDED, size, vertices[KIND, n],
                         child_size, face, vertices[CHILD_FACE, n], relative, phi)  # fmt: skip


@njit(cache=True, nogil=True)
def stand_all(model, chain, archive, objects, places):
    """Write (B, K, 3), the place of each object in each of (K, P) values.

    objects : (4, B) int64: the vertex, the vertex and the face below, and the unknown that is its theta.
    """
    phi = np.empty(7)
    for k in range(len(archive)):
        put_all(model, chain, archive[k])
        for b in range(objects.shape[1]):
            stand(model.vertices, chain.numbers, chain.pose, chain.relative, objects[1, b], objects[2, b],
                  objects[0, b], phi)  # fmt: skip
            places[b, k, 0] = wrap(phi[0], model.laws[objects[3, b], FOLD_PERIOD])
            places[b, k, 1], places[b, k, 2] = phi[1], phi[2]


@njit(cache=True, nogil=True)
def put_down(rng, vertices, laws, numbers, pose, relative, there, told, places, propose_at):
    """Write the pose `there` (4, 4) of a vertex; return the proposal's log ratio, NaN where there is none.

    told : the vertex, the vertex and face below it, and the unknown that turns it. places : see relocate.fitted.
    propose_at : address of the kernel's proposal, from an old place to a new one.
    """
    n, base, face = told[0], told[1], told[2]
    new, periods, phi = np.empty(3), np.zeros(3), np.empty(7)
    stand(vertices, numbers, pose, relative, base, face, n, phi)
    periods[0] = laws[told[3], FOLD_PERIOD]
    log_ratio = call_for_number(propose_at, rng, places, periods, phi[:3], new)
    if math.isnan(log_ratio):
        return math.nan
    for i in range(3):
        phi[i] = new[i]
    call_for_nothing(vertices[POSE_AT, n], vertices[CONTACT_CODE, n], UNBOUNDED, numbers[NOW, base, SIZES:SHAPES],
                     vertices[KIND, n], numbers[NOW, n, SIZES:SHAPES], face, vertices[CHILD_FACE, n], phi,
                     relative)  # fmt: skip
    compose(pose[NOW, base], relative, there)
    return log_ratio
