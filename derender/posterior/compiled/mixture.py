"""From a mixture of kernels and its tuning to the flat arrays of `layout.py`, and the addresses of what they call."""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from derender.compilation.cache import address_of
from derender.posterior.compiled import steps
from derender.posterior.compiled.contacts import put_down, reattach, stand_all
from derender.posterior.compiled.layout import SCALE, Chain, Kernels, Model
from derender.posterior.compiled.model import held
from derender.posterior.kernels import kernels
from derender.posterior.kernels.base import PLACING, ROW, Part, Tuning
from derender.posterior.kernels.relocate import mixture_of
from derender.posterior.space import Space
from derender.scene.contacts.compiled import FEATURE_CODES


class Calls(NamedTuple):
    """What one kernel calls, by addresses in this process; 0: nothing. vertex : whose children it keeps, or -1."""

    propose: int = 0
    place: int = 0
    keep: int = 0
    vertex: int = -1


def kernels_of(space: Space, parts: list[Part], tuning: Tuning, elsewhere: frozenset[int],
               places: Mapping[int, np.ndarray], calls: Sequence[Calls],
               below: Callable[[Sequence[str]], np.ndarray]) -> Kernels:  # fmt: skip
    """Return the mixture's arrays.

    elsewhere : numbers of the kernels whose steps the sweep leaves to its caller. places : see `places_seen`. below :
    see `objects_below`.
    """
    table, numbers, members, factors = [], [], [], []
    weight = 0.0
    first = factor_first = 0
    for k, (part, call) in enumerate(zip(parts, calls, strict=True)):
        kind = kernels[part.type]
        count, reach = (int(part.options["count"]), part.options["reach"]) if kind.form == ROW else (0, 0.0)
        if kind.form == PLACING:
            rows = below(part.block.objects)
            told, factor = [*rows[0, 1:3], *rows[:, 0], *rows[:, 3]], places[k]
        else:
            told, factor = list(kind.members(space, part.block)), kind.factor(space, part, tuning)
        weight += part.weight
        form = steps.ELSEWHERE if k in elsewhere else kind.form
        table.append((form, first, factor_first, call.vertex, call.propose, call.keep, call.place))
        numbers.append((weight, kind.scale(space, part, tuning), count, reach))
        members += told
        factors.append(np.ravel(factor))
        first += len(told)
        factor_first += factor.size
    return Kernels(
        table=np.ascontiguousarray(np.array([*table, (0, first, factor_first, -1, 0, 0, 0)], np.int64).T),
        numbers=np.array(numbers, float),
        members=np.array(members, np.int64),
        factors=np.concatenate(factors),
        spread=np.array(space.scales),
        mean=np.array(tuning.mean, float),
    )


def calls_of(target, parts: list[Part], model: Model, chain: Chain) -> list[Calls]:
    """Compile what a mixture's steps call and return where it lies."""
    rng, index, flat, members = np.random.default_rng(), np.int64(0), np.zeros(1), np.zeros(1, np.int64)
    calls = []
    for part in parts:
        kind, place, keep, vertex = kernels[part.type], 0, 0, -1
        if kind.form == PLACING:
            propose = address_of(kind.proposal, rng, flat, flat, flat, flat)
            place = address_of(put_down, rng, model.vertices, model.laws, chain.numbers, chain.pose, chain.relative,
                               chain.moved_pose, members, index, index, members, flat, index)  # fmt: skip
        else:
            propose = address_of(kind.proposal, rng, model.unknowns, model.laws, chain.values, chain.tangents, members,
                                 flat, 0.0, flat, flat)  # fmt: skip
        if kind.keeps_children:
            vertex = target.template.names.index(part.block.objects[0])
            keep = address_of(reattach, model.vertices, model.extents, model.places, model.laws, chain.values,
                              chain.numbers, chain.pose, chain.marks, flat, chain.relative, index, members,
                              chain.moved_pose)  # fmt: skip
        calls.append(Calls(propose, place, keep, vertex))
    return calls


def objects_below(target, objects: Sequence[str]) -> np.ndarray:
    """Return (B, 4) int64, of each relocated object: its vertex, the vertex and face that it is put on, its theta."""
    names, addresses = target.template.names, [unknown.address for unknown in target.space.unknowns]
    rows = []
    for name in objects:
        base, face = target.bases[name]
        theta = addresses.index(f"{name}.contact.theta")
        rows.append((names.index(name), names.index(base), FEATURE_CODES[face], theta))
    return np.array(rows, np.int64)


def places_seen(target, parts: list[Part], model: Model, chain: Chain, archive: np.ndarray) -> dict[int, np.ndarray]:
    """Return the flat mixtures over the places that objects have in (K, P) values, by the numbers of their kernels.

    chain : any of the model's; it is left at the last values.
    """
    chosen = {k: part.block.objects for k, part in enumerate(parts) if kernels[part.type].form == PLACING}
    if not chosen:
        return {}
    objects = sorted({name for names in chosen.values() for name in names})
    places = np.empty((len(objects), len(archive), 3))
    stand_all(model, chain, np.ascontiguousarray(archive, float), objects_below(target, objects).T.copy(), places)
    return {k: mixture_of(target, names, dict(zip(objects, places, strict=True))).flat() for k, names in chosen.items()}


def rescaled(space: Space, parts: list[Part], tuning: Tuning, program: Kernels) -> Kernels:
    """Return the arrays of a tuning that differs in its scales alone: a tenth of the time to make them anew."""
    changed = program.numbers.copy()
    changed[:, SCALE] = [kernels[part.type].scale(space, part, tuning) for part in parts]
    return program._replace(numbers=changed)


def taken_elsewhere(target, parts: list[Part]) -> frozenset[int]:
    """Return the numbers of the kernels that move a number which compiled steps cannot change."""
    kept = set(held(target).values())
    moved = [{target.space.offsets[i] for i in part.block.unknowns} for part in parts]
    return frozenset(k for k in range(len(parts)) if moved[k] & kept)
