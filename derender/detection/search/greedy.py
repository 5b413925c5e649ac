"""Explain the image by a set of solids: greedy addition of polished hypotheses, then sweeps of local moves.

Whole searches are put together from these in searches.py.
"""

from functools import partial
from operator import itemgetter
from typing import NamedTuple

import numpy as np

from derender.compilation.threads import THREADS
from derender.detection.search.observation import CORRELATED
from derender.detection.search.proposals import spaced
from derender.detection.solids.beliefs import Beliefs, Rules, bare_image
from derender.detection.solids.image import Image, rotation_of
from derender.detection.solids.interpenetration import highest
from derender.detection.solids.misfit import added_misfit, added_misfits
from derender.detection.solids.polish import FINE, FREE, SETTLED, SLACK, STEP, TRIED, UPRIGHT, size_energy, tilt_energy
from derender.detection.solids.state import Solid, State, energy, held_out, in_the_way, polish_solid, run_polish
from derender.detection.solids.support import assign_supports, concerned
from derender.scene.solids import BOX, SPHERE

# Rounds in which every promising hypothesis is polished, how many are kept then, and rounds for these.
SIFTING, KEPT, KEEPING = 50, 3, 100
# Rounds for the most promising cube in place of a box, and nats by which it may be worse than the box before them: 66
# of 68 cubes that were taken on made images were worse by less, half of those that were not by more.
CUBE_KEEPING, HOPELESS = 150, 300.0
HOPEFUL = 200.0  # nats by which a hypothesis may worsen the image before it is polished: its edges are pixels off
APART = 0.002  # metres between the sides of cubes that are tried: as far as polishing takes them at once
# Of solids on real tables, as sensors see them: what a search lets them be off.
REAL_TILT, REAL_SLACK = np.radians(1.5), 0.002
SHAPES = ("box", "cube", "cylinder", "sphere")  # names of the shapes that a search knows


class Settings(NamedTuple):
    """What the search is allowed.

    cube_bonus : log prior odds of a cube against the box that nearly is one: P(cube) over P(box) times the prior
        density of two sizes within the accuracy of the image.
    may_overlap, may_float : whether the terms against interpenetration and against floating are switched off.
    reduced : whether the image is seen at fewer pixels than it came with: silhouettes lie up to half of one off then.
    quiet, worthwhile, clean : they end after `quiet` moves, and three for each solid, that gained less than
        `worthwhile` nats, when less than `clean` badly explained pixels are left.
    tries : searches side by side, and climbs to the mode, of which the best counts; 1 is quick and sometimes wrong.
    until : time.monotonic() from which on draws that do not agree yet are not gone on with; None: while it is worth it.
    """

    shapes: tuple[str, ...] = SHAPES  # names of the shapes that may occur
    max_objects: int = 30  # how many solids there may be
    counts_all: bool = False  # whether that was said, and of free-form things too
    price: float = 40.0  # nats that a solid must gain to be believed
    slack: float = SLACK  # metres within which contacts hold
    tilt: float = 0.0  # radians off the vertical that a standing solid may have
    cube_bonus: float = 7.0
    free_price: float = 8.0  # nats that a tilted pose costs more than an upright one
    repairs: int = 120  # most moves between structures
    quiet: int = 10
    worthwhile: float = 3.0
    clean: float = 4.0
    floating_price: float = 30.0  # nats that a solid costs that nothing carries
    temper: float = 1.0  # how many pixels tell as much as one independent one; prices are multiplied by it already
    shared: float = 0.0  # the least that noise of neighbouring pixels is taken to correlate
    uneven: float = 0.01  # metres by which a floor and its image may be off the plane
    faces: float = 0.0  # metres by which faces of real solids lie off where they appear to, in draws
    tries: int = THREADS
    may_overlap: bool = False
    may_float: bool = False
    free_forms: bool = True  # whether there may be things of no such shape
    reduced: bool = False
    beliefs: Beliefs | None = None  # of weights and draws, None: the default ones; the search has its own prior
    until: float | None = None

    @property
    def believed(self) -> Beliefs:
        """What is believed of weights and draws."""
        return bare_image() if self.beliefs is None else self.beliefs

    @property
    def rules(self) -> Rules:
        """What solids may do to each other, see beliefs.Rules."""
        overlap = np.inf if self.may_overlap else None
        beliefs = self.believed
        slack = beliefs.loose.slack_seen if self.faces > 0.0 else beliefs.loose.slack
        return Rules(slack, overlap, self.may_float, beliefs, self.faces)

    @property
    def price_of_box(self) -> float:
        """Nats that an upright box must gain to be believed."""
        return self.price + self.cube_bonus

    @property
    def price_of_floating(self) -> float:
        """Nats that standing on nothing costs; where solids may float, what a height anywhere in a metre costs."""
        return self.temper * np.log(1.0 / self.slack) if self.may_float else self.floating_price

    def for_correlation(self, correlation: float) -> "Settings":
        """Return the settings for an image whose neighbouring residuals have this correlation.

        How many pixels tell as much as one independent one then, the prior says (`Shared`).
        """
        loose = (bare_image() if self.beliefs is None else self.beliefs).loose
        faces = loose.faces if correlation > CORRELATED else 0.0
        correlation = min(correlation, loose.shared.most)
        if correlation < loose.shared.least:
            return self
        factor = ((1 + correlation) / (1 - correlation)) ** loose.shared.power
        return self.for_pixels(factor)._replace(clean=self.clean * factor**2, tilt=REAL_TILT, slack=REAL_SLACK,
                                                faces=faces)  # fmt: skip

    def for_pixels(self, many: float) -> "Settings":
        """Return the settings for an image of which so `many` pixels tell as much as one did."""
        return self._replace(price=self.price * many, cube_bonus=self.cube_bonus * many,
                             free_price=self.free_price * many, floating_price=self.floating_price * many,
                             temper=self.temper * many)  # fmt: skip


energy_of = itemgetter(1)  # of what `run_polish` returns
Changed = tuple[State, set[int]]  # what a move makes of a state: another one, and the indices of what it changed


class Task(NamedTuple):
    """What a search is about: the image, what is allowed, and hypotheses of the solids that it shows."""

    image: Image
    settings: Settings
    hypotheses: list[Solid] = []  # noqa: RUF012  (never written)


def greedy(
    rng: np.random.Generator,
    image: Image,
    hypotheses: list[Solid],
    settings: Settings,
    state: State | None = None,
    tried: int = 5,
    shake: float = 0.0,
) -> State:
    """Add the best polished hypothesis again and again while it gains more than its price.

    tried : how many of the most promising hypotheses are polished at each step.
    shake : each gain is multiplied by a uniform number in [1 - shake, 1] before the most promising are taken.
    """
    state = State() if state is None else state
    alive = list(hypotheses)

    def tried_out(solid, rounds, step):
        """Return (it, energy) of a hypothesis polished from here."""
        solid, energy = run_polish(rng, image, state, -1, solid, view, settings, rounds, step)
        return solid, energy + complexity(solid, settings)

    while alive and len(state) < settings.max_objects:
        view = held_out(image, state, -1)
        gains = -added_misfits(image, np.array([each.row for each in alive]), view[0], view[2])
        order = promising(gains * rng.uniform(1 - shake, 1, len(gains)), [each.kind for each in alive], tried)
        sifted = sorted((tried_out(alive[k], SIFTING, STEP) for k in order), key=energy_of)
        solid, energy = min((tried_out(each, KEEPING, FINE) for each, _ in sifted[:KEPT]), key=energy_of)
        if energy > 0:
            break
        state = state.add(*run_polish(rng, image, state, -1, solid, view, settings, SETTLED, FINE)[0])
        alive = [a for a, gain in zip(alive, gains, strict=True) if gain > -HOPEFUL]
    return state


def promising(gains: np.ndarray, kinds: list[int], tried: int) -> list[int]:
    """Return the indices of the `tried` greatest gains, and of the next ones of each kind of solid (half as many)."""
    order = np.argsort(-gains)
    chosen = list(order[:tried])
    for kind in set(kinds):
        chosen += [k for k in order[tried:] if kinds[k] == kind and gains[k] > -HOPEFUL][: (tried + 1) // 2]
    return chosen


def sweep(
    rng: np.random.Generator,
    image: Image,
    state: State,
    settings: Settings,
    rounds: int,
    step: float = FINE,
    heat: float = 1.0,
    only: set[int] | None = None,
) -> State:
    """Polish each solid (or those in `only`) in turn, held to what it stands on; in place."""
    for i in rng.permutation(len(state)):
        if only is not None and i not in only:
            continue
        polish_solid(rng, image, state, i, settings, state.bottoms[i], rounds, step, heat)
    return state


def try_cubes(
    rng: np.random.Generator, image: Image, state: State, settings: Settings, only: set[int] | None = None
) -> State:
    """Make a cube of each box (or those in `only`) where the image allows it; return a new state."""
    state = state.copy()
    for i in range(len(state)):
        solid = state[i]
        if solid.kind != BOX or solid.cube or (only is not None and i not in only):
            continue
        polished = partial(run_polish, rng, image, state, i, view=held_out(image, state, i), settings=settings)
        most = polished(solid, rounds=1)[1] + settings.cube_bonus
        sides = spaced([*solid.row[13:16], solid.row[13:16].mean()], APART)
        cubes = [cube_of(solid, side, image.origin) for side in sides]
        cube, least = min((polished(each, rounds=SIFTING) for each in cubes), key=energy_of)
        if least < most + settings.temper * HOPELESS:
            cube, least = polished(cube, rounds=CUBE_KEEPING)
        if least < most:
            state = state.replaced(i, cube)
    return state


def cube_of(solid: Solid, side: float, origin: np.ndarray) -> Solid:
    """Return the cube of this side with the corner nearest the camera (for an upright one, on its bottom) held."""
    new, rotation = solid.row.copy(), rotation_of(solid.row)
    towards = np.sign((origin - new[10:13]) @ rotation)
    if solid.form == UPRIGHT:
        towards[2] = -1.0
    new[10:13] += rotation @ (towards * (new[13:16] - side) / 2)
    new[13:16] = side
    return solid._replace(row=new, cube=True)


def rise(solid: Solid) -> float:
    """Return how high over the floor the middle of an upright solid's top is, metres; of another its highest point: of
    a wide slab that is tilted as little as solids may be, a corner is far higher."""
    row = solid.row
    return float(row[12] + 0.5 * row[15]) if solid.form == UPRIGHT else highest(row)


def prune(image: Image, state: State, settings: Settings, only: set[int] | None = None) -> State:
    """Remove solids (or some of those in `only`) whose removal costs less than their price, and what is no higher than
    floors are uneven.

    Returns a new state.
    """
    i = 0
    while i < len(state):
        if rise(state[i]) < settings.uneven:
            state, i, only = state.without(i), 0, None
            continue
        if only is not None and i not in only:
            i += 1
            continue
        depth, _, misfit, _ = held_out(image, state, i)
        kept = added_misfit(image, state.rows[i], depth, misfit)
        kept += settings.temper * size_energy(state.rows[i], state.cubes[i])
        if kept + complexity(state[i], settings) > 0:
            state, i, only = state.without(i), 0, None
        else:
            i += 1
    return state


def settle(
    rng: np.random.Generator,
    image: Image,
    state: State,
    settings: Settings,
    rounds: int = TRIED,
    only: set[int] | None = None,
) -> State:
    """Put every solid on its support, polish, make cubes, and prune; return a new state.

    only : the solids that have changed since this was done, None for all.
    """
    near = None if only is None else concerned(image, state, only)
    state = assign_supports(image, state, settings, near)
    sweep(rng, image, state, settings, rounds, only=only)
    state = try_cubes(rng, image, state, settings, only=only)
    kept = prune(image, state, settings, near)
    return assign_supports(image, kept, settings, near if len(kept) == len(state) else None)


def complexity(solid: Solid, settings: Settings) -> float:
    """Return the price in nats of a solid: more for each number that a simpler solid would not need."""
    price = settings.price_of_box if solid.kind == BOX and not solid.cube else settings.price
    if solid.kind != SPHERE and solid.form == FREE:
        price += settings.free_price
    return price


def total_energy(image: Image, state: State, settings: Settings) -> float:
    """Return minus the log posterior density of a state, up to a constant."""
    total = energy(image, state, settings.slack, settings.temper, in_the_way(state.rows, settings))
    for solid in state:
        total += complexity(solid, settings)
        total += settings.temper * tilt_energy(solid.row, solid.form, settings.tilt)
        if np.isnan(solid.bottom) and solid.parent < 0:
            total += settings.price_of_floating
    return total
