"""The state of the search over structures: which solids there are and what each one stands on."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from derender.detection.solids.image import ROW, Image, blank, draw
from derender.detection.solids.interpenetration import lowest
from derender.detection.solids.misfit import misfit_map
from derender.detection.solids.polish import MOVED, STEP, UPRIGHT, contact_energy, polish, size_energy

if TYPE_CHECKING:
    from derender.detection.search.greedy import Settings

FLOOR = -1
NOTHING = np.empty(0)


class Solid(NamedTuple):
    """A solid over a floor, in the floor frame."""

    row: np.ndarray  # (ROW,) float64, see image.py
    form: int  # UPRIGHT (its own z axis is the floor's) or FREE
    cube: bool = False  # whether its edges are equal by construction
    parent: int = FLOOR  # what it stands on: FLOOR or an index
    bottom: float = np.nan  # height that its lowest point is held to, NaN for none

    @property
    def kind(self) -> int:
        """Its code of scene.solids."""
        return int(self.row[0])

    def on(self, bottom: float, parent: int = FLOOR) -> "Solid":
        """Return the solid on what is so high; only one that stands upright is held to it."""
        return self._replace(parent=parent, bottom=bottom if self.form == UPRIGHT else np.nan)


@dataclass
class State:
    """Solids over a floor: what `Solid` says of each, for all of them."""

    rows: np.ndarray = field(default_factory=lambda: np.empty((0, ROW)))
    forms: list[int] = field(default_factory=list)
    cubes: list[bool] = field(default_factory=list)
    parents: list[int] = field(default_factory=list)
    bottoms: list[float] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.forms)

    def __getitem__(self, index: int) -> Solid:
        return Solid(self.rows[index], self.forms[index], self.cubes[index], self.parents[index], self.bottoms[index])

    def __iter__(self) -> Iterator[Solid]:
        return map(self.__getitem__, range(len(self)))

    def copy(self) -> "State":
        return State(self.rows.copy(), list(self.forms), list(self.cubes), list(self.parents), list(self.bottoms))

    @classmethod
    def of(cls, solids: Sequence[Solid]) -> "State":
        """Return the state of these solids."""
        rows = np.array([solid.row for solid in solids], float).reshape(-1, ROW)
        forms, cubes = [solid.form for solid in solids], [solid.cube for solid in solids]
        return cls(rows, forms, cubes, [solid.parent for solid in solids], [solid.bottom for solid in solids])

    def add(self, row: np.ndarray, form: int, cube: bool, parent: int = FLOOR, bottom: float = np.nan) -> "State":
        """Return the state with one more Solid."""
        return State.of([*self, Solid(row, form, cube, parent, bottom)])

    def changed(self, index: int, **numbers: Any) -> "State":
        """Return the state with another `row`, `form`, `cube`, `parent` or `bottom` of one solid."""
        return self.replaced(index, self[index]._replace(**numbers))

    def replaced(self, index: int, solid: Solid) -> "State":
        """Return the state with another Solid in the place of one."""
        new = self.copy()
        for values, value in zip((new.rows, new.forms, new.cubes, new.parents, new.bottoms), solid, strict=True):
            values[index] = value  # type: ignore[index]
        return new

    def swapped(self, index: int, solid: Solid) -> "State":
        """Return the state with another Solid in the place of one, on what that stands on."""
        return self.replaced(index, solid._replace(parent=self.parents[index]))

    def chosen(self, solids: list[int], parents: list[int]) -> "State":
        """Return the state of some solids, in this order, on these parents."""
        return State.of([self[k]._replace(parent=parent) for k, parent in zip(solids, parents, strict=True)])

    def without(self, *indices: int) -> "State":
        """Return the state without some solids; what stood on one stands on what that stood on."""
        state = self
        for index in sorted(set(indices), reverse=True):
            heir, keep = state.parents[index], [k for k in range(len(state)) if k != index]
            parents = (heir if state.parents[k] == index else state.parents[k] for k in keep)
            state = state.chosen(keep, [parent - (parent > index) for parent in parents])
        return state

    def in_order(self) -> list[int]:
        """Return the solids as people count them: those on the floor from left to right, then what stands on them.

        Two runs on one image thus give one solid one name.
        """

        def level(k: int, seen: tuple[int, ...] = ()) -> int:
            parent = self.parents[k]
            return 0 if parent == FLOOR or parent in seen else 1 + level(parent, (*seen, k))

        return sorted(range(len(self)), key=lambda k: (level(k), self.rows[k, 10]))

    def ordered(self) -> "State":
        """Return the state with its solids `in_order`."""
        order = self.in_order()
        place = {FLOOR: FLOOR, **{k: new for new, k in enumerate(order)}}
        return self.chosen(order, [place[self.parents[k]] for k in order])


def subset(state: State, keep: set[int]) -> State:
    """Return the State of these solids alone."""
    return state.without(*(set(range(len(state))) - keep))


def carried_by(state: State, index: int) -> np.ndarray:
    """Return the (K,) heights of the lowest points of the solids that are held to the top of solid `index`."""
    if index == FLOOR:  # of a solid that is not there yet: nothing, and not what stands on the floor
        return NOTHING
    held = [k for k in range(len(state)) if state.parents[k] == index and not np.isnan(state.bottoms[k])]
    return np.array([lowest(state.rows[k]) for k in held])


def held_out(image: Image, state: State, index: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Return depth, label, misfit and total misfit of the scene without solid `index` (-1: all of it)."""
    depth, label, misfit = blank(image)
    draw(image, state.rows, index, depth, label)
    total = misfit_map(image, depth, misfit)
    return depth, label, misfit, total


def in_the_way(rows: np.ndarray, settings: "Settings") -> np.ndarray:
    """Return the solids (N, ROW) that others must not enter: none where interpenetration is allowed."""
    return rows[:0] if settings.may_overlap else rows


def energy(image: Image, state: State, slack: float, temper: float, in_the_way: np.ndarray) -> float:
    """Return misfit + prior + contact energies of a state: minus its log posterior density up to a constant.

    in_the_way : (N, ROW) the solids that must not be entered: those of the state, or none.
    temper : how many pixels tell as much as one independent one: what the sizes' prior is multiplied by.
    """
    *_, total = held_out(image, state, -1)
    for k in range(len(state)):
        total += temper * size_energy(state.rows[k], state.cubes[k])
        total += contact_energy(state.rows[k], in_the_way, k, state.bottoms[k], NOTHING, slack)
    return total


def run_polish(
    rng: np.random.Generator,
    image: Image,
    state: State,
    index: int,
    solid: Solid,
    view: tuple[np.ndarray, np.ndarray, np.ndarray, float],
    settings: "Settings",
    rounds: int = MOVED,
    step: float = STEP,
    heat: float = 2.0,
) -> tuple[Solid, float]:
    """Polish one solid against the rest of the scene, `view`, without number `index`; return (it, energy)."""
    depth, _, misfit, _ = view
    row, energy, _ = polish(
        rng, image, solid.row, solid.form, solid.cube, in_the_way(state.rows, settings), index, depth, misfit,
        solid.bottom, carried_by(state, index), settings.slack, settings.tilt, settings.temper, rounds, step, heat,
    )  # fmt: skip
    return solid._replace(row=row), energy


def polish_solid(
    rng: np.random.Generator,
    image: Image,
    state: State,
    k: int,
    settings: "Settings",
    bottom: float = np.nan,
    rounds: int = MOVED,
    step: float = STEP,
    heat: float = 2.0,
) -> None:
    """Polish solid k of a state in place, all others held; bottom : height that its lowest point is held to."""
    solid, view = state[k]._replace(bottom=bottom), held_out(image, state, k)
    state.rows[k] = run_polish(rng, image, state, k, solid, view, settings, rounds, step, heat)[0].row
