"""Whole searches: greedy, then moves between structures where the image is badly explained; again until two agree.

How blurred the image is, a first explanation tells better than its steps alone: beside a step of a metre a hundredth of
a pixel more blur is worth several standard deviations of the noise, and with the blur a little wrong the search fills
the silhouettes with thin solids.
"""

from collections.abc import Iterator
from functools import partial
from typing import NamedTuple

import numpy as np

from derender.compilation.threads import THREADS, in_threads
from derender.detection.patches import components
from derender.detection.search.bodies import FEWEST, box_about
from derender.detection.search.greedy import Changed, Settings, Task, greedy, prune, settle, sweep, total_energy
from derender.detection.search.moves import (
    LOWER,
    aligned_pairs,
    appear_on,
    merge_pair,
    parted_pairs,
    polished,
    propose,
    put_under,
    raise_support,
    stand,
)
from derender.detection.search.places import MISFIT, Places, find_places
from derender.detection.search.proposals import smallest_rectangle
from derender.detection.solids.image import Image, blank, draw, rotation_of, taps_of
from derender.detection.solids.interpenetration import highest, lowest
from derender.detection.solids.misfit import LIMIT, misfit_map
from derender.detection.solids.polish import FINEST, FREE, SETTLED, TRIED, UPRIGHT
from derender.detection.solids.state import FLOOR, Solid, State, held_out
from derender.detection.solids.support import share_over
from derender.scene.solids import BOX

FIRST_LOOK = (0.0, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0, 1.3, 1.7, 2.1, 2.6, 3.2)  # standard deviations in pixels
STEPS = (0.2, 0.1, 0.05, 0.025, 0.0125, 0.006, 0.003)  # of the closer look: more in all than half of any gap


def refocused(image: Image, rows: np.ndarray, price: float) -> tuple[Image, float]:
    """Return (image with the blur under which the solids explain it best, how much smaller its misfit is).

    price : nats that a blur must gain to be believed of an image that was taken for sharp.
    """
    clear, label, misfit = blank(image)
    draw(image, rows, -1, clear, label)

    def score(blur):
        return misfit_map(image._replace(taps=taps_of(blur)), clear, misfit), blur

    before = misfit_map(image, clear, misfit)
    best = min(score(blur) for blur in FIRST_LOOK)
    for step in STEPS:
        best = min(best, *(score(max(best[1] + way * step, 0.0)) for way in (-1, 1)))
    gained = before - best[0]
    if gained <= (price if image.taps.size == 1 else 0.0):
        return image, 0.0
    return image._replace(taps=np.ascontiguousarray(taps_of(best[1]))), gained


# Share by which the gains of first solids are shaken (see `greedy`) in every other search: those that begin with the
# same solids end in the same optima, and their agreement would tell nothing.
SHAKEN = 0.5
FOCUSED = 4  # greedy searches for the blur, at most: each tells it better
ROUNDS = 2  # of as many searches as there are threads, at most
HANGING_ROUNDS = 5  # the same while something hangs in the air in the best found: what bears it was not found
AGREEING, APIECE = 8.0, 2.0  # nats between the energies of searches that found the same: in all, or for each solid
# Moves between structures of a search that goes on where free-form things are known: some settings.repairs take a whole
# search there, and this one begins with most of the structure.
ON_REPAIRS = 24
UNSETTLED = 200.0  # nats that a merged solid may cost before those about it are settled
IN_VAIN = 4  # times as many rounds without success as where all is explained: what a sensor loses at edges stays
SHARED = 0.1  # of the pixels of one of two solids that both show from which on they belong to one part
CUTS = np.linspace(0.1, 0.9, 17)  # shares of the pixels on one side of the cuts that are tried through what shows two
MOST_PARTED = 300  # tries of two solids for one, in all: of a floor that none is to be, and solids are, 2,600 took 50 s
SUPPORTING = 6  # tries for each solid of the scene to support one that floats


def search(
    rng: np.random.Generator,
    image: Image,
    hypotheses: list[Solid],
    settings: Settings,
    pool: list[tuple[State, float]] | None = None,
    start: State | None = None,
) -> tuple[State, Image, bool]:
    """Return (best State found, Image with the blur that it shows, whether a second search found the same).

    Searches run in pairs, each with random numbers of its own, until two agree about the least energy and how many
    solids there are, or ROUNDS pairs have not, and longer while something hangs in the air; where `settings` allow one
    try there is one. (state, energy) of all that were tried are appended to the list `pool`. From a State `start` one
    pair goes on, for ON_REPAIRS moves.

    Raises Interrupted with the best so far on Ctrl-C, once there is one.
    """
    found: list[Found] = []
    early: list[Found] = []
    agreed = False
    if start is not None:
        settings = settings._replace(repairs=ON_REPAIRS)
    task = partial(one_search, image=image, hypotheses=hypotheses, settings=settings, early=early, state=start)
    for number in range(HANGING_ROUNDS if start is None else 1):
        try:
            found += in_threads(rng, [partial(task, shake=SHAKEN * (k % 2)) for k in range(settings.tries)])
        except KeyboardInterrupt:
            if not (found or early):
                raise
            best = min([*found, *early], key=lambda each: each.energy)
            raise Interrupted(best.state, best.image) from None
        found.sort(key=lambda each: each.energy)
        if len(found) == 1:  # nothing to hold it against
            break
        agreed = agree(found, settings)
        hanging = settings.temper == 1.0 and not settings.may_float and floats(found[0].state)
        if not hanging and (agreed or number + 1 >= ROUNDS):
            break
    for each in found[1:]:
        state = crossed(rng, found[0].image, found[0].state, each.state, settings)
        if state is not found[0].state:
            found[0] = found[0]._replace(state=state, energy=total_energy(found[0].image, state, settings))
    if pool is not None:
        for each in found:
            pool += each.pool
        pool += [(each.state, each.energy) for each in found[1:]]
    return found[0].state, found[0].image, agreed


def agree(found: "list[Found]", settings: Settings) -> bool:
    """Whether the two best of some Found, by energy, are as good as each other and as many solids stand on the floor
    and on others. Of which kinds they are is weighed later.

    On a real sensor's images, whose bends are taken for this solid or that, it is enough that they are as good.
    """
    one, other = (each.state for each in found[:2])
    if found[1].energy - found[0].energy > settings.temper * max(AGREEING, APIECE * len(one)):
        return False
    counts = [(len(state), state.parents.count(FLOOR)) for state in (one, other)]
    return settings.temper > 1.0 or counts[0] == counts[1]


class Interrupted(KeyboardInterrupt):
    """Ctrl-C in a search that has found something: `state`, the best so far, and the Image in its focus."""

    def __init__(self, state: State, image: Image) -> None:
        super().__init__("interrupted")
        self.state, self.image = state, image


def crossed(rng: np.random.Generator, image: Image, state: State, other: State, settings: Settings) -> State:
    """Return a State with parts of another in place of its own wherever that lowers the energy.

    Searches end in optima that are better here in one and there in the other.
    """
    climb, tried = Climb(rng, Task(image, settings), state), set[tuple[int, ...]]()
    while untried := [part for part in parts(image, climb.state, other) if part[1] and part[1] not in tried]:
        mine, theirs = untried[0]
        tried.add(theirs)
        trial = climb.state.without(*mine)
        count = len(trial)
        for k in theirs:
            trial = trial.add(*other[k][:3])
        climb.takes((trial, set(range(count, len(trial)))))
    return climb.state


def parts(image: Image, state: State, other: State) -> list[tuple[tuple[int, ...], tuple[int, ...]]]:
    """Return the solids of one state and of another, by index, of each part of the scene: what shows in the same pixels
    hangs together."""
    one, two = (held_out(image, each, -1)[1] for each in (state, other))
    count, more = len(state), len(other)
    both = (one >= 0) & (two >= 0)
    shared = np.zeros((count, more), int)
    np.add.at(shared, (one[both], two[both]), 1)
    least = np.minimum(np.bincount(one[one >= 0], minlength=count)[:, None], np.bincount(two[two >= 0], minlength=more))
    tied = np.zeros((count + more, count + more), bool)
    tied[:count, count:] = shared > SHARED * least
    return [(tuple(k for k in part if k < count), tuple(k - count for k in part if k >= count))
            for part in components(tied)]  # fmt: skip


def first_search(rng: np.random.Generator, image: Image, hypotheses: list[Solid], settings: Settings) -> State:
    """Return the best State of two greedy searches, settled: what is plain to see, in a tenth of a whole search."""
    task = partial(settled_greedy, image=image, hypotheses=hypotheses, settings=settings)
    return min(in_threads(rng, [task] * THREADS), key=lambda found: found[1])[0]


def settled_greedy(
    rng: np.random.Generator, image: Image, hypotheses: list[Solid], settings: Settings
) -> tuple[State, float]:
    """Return (State, energy) of one greedy search, settled."""
    state = settle(rng, image, greedy(rng, image, hypotheses, settings), settings)
    return state, total_energy(image, state, settings)


class Found(NamedTuple):
    """What one search found: the best State, its energy, the Image in focus, and (state, energy) of all it tried."""

    state: State
    energy: float
    image: Image
    pool: list


def one_search(
    rng: np.random.Generator,
    image: Image,
    hypotheses: list[Solid],
    settings: Settings,
    early: list[Found],
    state: State | None = None,
    shake: float = 0.0,
) -> Found:
    """Return the Found of one search: greedy, then moves between structures, then what should be tried in any case.

    early : list to which it appends the Found of what was settled before the moves.
    state : to begin with instead of a greedy search. shake : of that search, see `greedy`.
    """
    if state is None:
        for _ in range(FOCUSED):
            found = greedy(rng, image, hypotheses, settings, shake=shake)
            image, gained = refocused(image, found.rows, settings.price)
            if gained <= settings.price:  # else what stood for the blur is not to be polished but found otherwise
                break
        state = settle(rng, image, found, settings)
        image, _ = refocused(image, state.rows, settings.price)
    climb = Climb(rng, Task(image, settings, hypotheses), state.copy())  # the other search goes on from the same
    early.append(Found(state.copy(), climb.energy, image, []))
    for stage in (explain_rest, repair, explain_rest, explain_otherwise, explain_by_two):
        stage(climb)
    last = Climb(rng, climb.task, climb.state)  # what it tries none looks at again
    support_all(last)
    for of_one in (merged, reached):  # as long as that helps
        while any(last.takes(changed, may_cost=UNSETTLED) for changed in of_one(last)):
            pass
    last.takes((last.state, None), SETTLED)
    state = last.state
    sweep(rng, image, state, settings, SETTLED, FINEST, 0.0)
    state = prune(image, state, settings)
    return Found(state, total_energy(image, state, settings), image, climb.pool)


class Climb:
    """A search that goes on from a State: the best so far, its energy, and `pool`, (State, energy) of all it tried."""

    def __init__(self, rng: np.random.Generator, task: Task, state: State) -> None:
        self.rng, self.task, self.state = rng, task, state
        self.energy = total_energy(task.image, state, task.settings)
        self.pool: list[tuple[State, float]] = []

    def places(self) -> Places:
        """Return where the image is badly explained."""
        return find_places(self.task.image, self.state)

    def takes(self, tried: tuple[State, set[int] | None], rounds: int = TRIED, may_cost: float | None = None) -> bool:
        """Settle what a move has made, and go on from it if that lowers the energy; return whether it does.

        may_cost : nats that it may cost before it is settled, None: any.
        """
        (new, changed), (image, settings, _) = tried, self.task
        if may_cost is not None and total_energy(image, new, settings) > self.energy + settings.temper * may_cost:
            return False
        new = settle(self.rng, image, new, settings, rounds, changed)
        self.pool.append((new, total_energy(image, new, settings)))
        better = self.pool[-1][1] < self.energy
        if better:
            self.state, self.energy = self.pool[-1]
        return better


def repair(climb: Climb) -> None:
    """Try moves between structures where the image is badly explained.

    Ends after settings.repairs rounds, or after settings.quiet rounds without success (three for each solid besides)
    when hardly any misfit is left that noise would not leave, or, but on a real sensor's images, after IN_VAIN times as
    many (a quick search: as many) whatever is left.
    """
    settings, places, quiet = climb.task.settings, climb.places(), 0
    in_vain: float = 1 if settings.tries == 1 else IN_VAIN
    in_vain = in_vain if settings.temper == 1.0 else np.inf  # what a real sensor bends may yet be a solid
    for _ in range(settings.repairs):
        enough = settings.quiet + 3 * len(climb.state)
        if places.none_left(settings):
            if quiet >= enough or settings.tries == 1:  # a quick search does not look for what is better still
                break
        elif quiet >= in_vain * enough:
            break
        quiet += 1
        before, proposed = climb.energy, propose(climb.rng, climb.task, climb.state, places)
        if proposed is not None and climb.takes(proposed):
            quiet = quiet if climb.energy > before - settings.worthwhile else 0
            places = climb.places()


def explain_rest(climb: Climb) -> None:
    """Try a new solid for each body of pixels that nothing explains, but for those that could not pay for a solid."""
    settings = climb.task.settings
    for body in sorted(climb.places().bodies, key=len, reverse=True):
        if len(body) * LIMIT < settings.price or len(climb.state) >= settings.max_objects:
            break
        below = {0.0, *(highest(row) for row in climb.state.rows if share_over(body, row) > 0.0)}
        for bottom in sorted(height for height in below if height < body[:, 2].max() - LOWER):
            climb.takes(appear_on(climb.rng, climb.task, climb.state, body, bottom))


def explain_otherwise(climb: Climb) -> None:
    """Try to explain by boxes what each badly explained round solid shows, and the other way round.

    A greedy search takes what explains most at once, as one can does of two stacked cubes. The cubes explain more
    together but either less alone, so as long as cans are among the hypotheses one is taken again.
    """
    image, settings, hypotheses = climb.task
    for k in reversed(np.flatnonzero(climb.places().blame[:-1] >= FEWEST)):
        if k >= len(climb.state):  # a solid was pruned
            continue
        was_box, fewer = int(climb.state.rows[k][0]) == BOX, climb.state.without(int(k))
        others = [each for each in hypotheses if (each.kind == BOX) != was_box]
        new = greedy(climb.rng, image, others, settings, fewer)
        climb.takes((new, set(range(len(fewer), len(new)))))


def explain_by_two(climb: Climb) -> None:
    """Try two solids in place of each that leaves more of what it shows unexplained than another one costs, as long as
    that helps, MOST_PARTED times at most: a telephone and the book beside it are one slab to a greedy search, and that
    no move at random hits on both is chance."""
    tries = iter(range(MOST_PARTED))
    while len(climb.state) < climb.task.settings.max_objects:
        if not any(climb.takes(changed) for _, changed in zip(tries, parted(climb), strict=False)):
            break


def parted(climb: Climb) -> Iterator[Changed]:
    """Yield the state with each such solid as two: cut across either of its longer axes, where two planes explain best
    what it shows, and what shows on either side explained anew."""
    (image, settings, _), state = climb.task, climb.state
    boxes = [each for each in settings.shapes if each == "box"]  # by itself a round solid may explain more of a piece
    tasks = [climb.task, *(climb.task._replace(settings=settings._replace(shapes=(each,))) for each in boxes)]
    _, label, misfit, _ = held_out(image, state, -1)
    shown = (label >= 0) & (image.weight > 0)
    bad = shown & (misfit > MISFIT)
    left = np.bincount(label[bad], misfit[bad], len(state))
    for k in sorted(np.flatnonzero(left > settings.price).tolist(), key=lambda each: -left[each]):
        row = state.rows[k]
        points = (image.origin + image.depth[..., None] * image.direction)[shown & (label == k)]
        for axis in np.argsort(-row[13:16])[:2]:
            low = lower_side(points, points @ rotation_of(row)[:, axis])
            if low is None:
                continue
            for task in tasks:
                new, bottom = state.without(k), max(lowest(row), 0.0)
                for piece in (points[low], points[~low]):
                    new, _ = appear_on(climb.rng, task, new, piece, bottom)
                both = {len(new) - 2, len(new) - 1}
                yield new, both
            yield leaning(climb, new, both), both


def leaning(climb: Climb, state: State, among: set[int]) -> State:
    """Return a State in which that solid of some leans that leaves most unexplained, as it explains the image best."""
    _, label, misfit, _ = held_out(climb.task.image, state, -1)
    worst = max(among, key=lambda k: misfit[label == k].sum())
    return polished(climb.rng, climb.task, state, worst, state[worst]._replace(form=FREE, cube=False, bottom=np.nan))[0]


def lower_side(points: np.ndarray, along: np.ndarray) -> np.ndarray | None:
    """Return (N,) bool: which of points (N, 3) lie on the lower side of that of some cuts on whose sides two planes
    leave least of their squared heights; None where either side would be too few. along : (N,) where they lie."""
    best, least = None, np.inf
    design = np.column_stack([points[:, :2], np.ones(len(points))])
    for place in np.quantile(along, CUTS):
        low = along < place
        if min(low.sum(), (~low).sum()) < FEWEST:
            continue
        off = [
            points[side, 2] - design[side] @ np.linalg.lstsq(design[side], points[side, 2])[0] for side in (low, ~low)
        ]
        if (squares := float(sum(each @ each for each in off))) < least:
            best, least = low, squares
    return best


def support_all(climb: Climb) -> None:
    """Try to put something under each solid that floats, or to raise what is below it, as long as that is worthwhile:
    polishing alone gains a little each time, and one search in hundreds went on so for a minute."""
    settings, places, tries = climb.task.settings, climb.places(), 0
    while floats(climb.state) and tries < min(SUPPORTING * len(climb.state), settings.repairs):
        proposed = (raise_support, put_under, stand)[tries % 3](climb.rng, climb.task, climb.state, places)
        before, tries = climb.energy, tries + 1
        if proposed is not None and climb.takes(proposed):
            places, tries = climb.places(), tries if climb.energy > before - settings.worthwhile else 0


def floats(state: State) -> bool:
    """Whether nothing bears some solid of the state."""
    return any(np.isnan(solid.bottom) and solid.parent < 0 for solid in state)


def merged(climb: Climb) -> Iterator[Changed]:
    """Yield the state with each two that may be one solid as one, grown where they differ most or along all axes."""
    state = climb.state
    for i, j in aligned_pairs(state):
        for spread in ((False, False, False), (True, True, True)):
            yield merge_pair(climb.rng, climb.task, state, i, j, spread)
    for i, j in parted_pairs(climb.task.image, state):
        yield merge_pair(climb.rng, climb.task, state, i, j, (False, False, False))


def reached(climb: Climb) -> Iterator[Changed]:
    """Yield the state with a solid that reaches to what nothing explains, and which may be its other end: another hides
    what is between. That end may show in too few pixels to be a solid by itself."""
    state, last = climb.state, len(climb.state)
    for body in climb.places().bodies:
        for bottom in {max(lowest(row), 0.0) for row in state.rows}:
            if body[:, 2].max() < bottom + LOWER:
                continue
            end = state.add(box_about(body, smallest_rectangle(body[:, :2]), bottom), UPRIGHT, False, FLOOR, bottom)
            for i, j in parted_pairs(climb.task.image, end):
                if j == last:
                    yield merge_pair(climb.rng, climb.task, end, i, j, (False, False, False))
