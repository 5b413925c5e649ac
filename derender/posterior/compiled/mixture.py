"""From a mixture of kernels and its tuning to the flat arrays of `layout.py`, and the addresses of what they call."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from derender.compilation.call import address_of
from derender.posterior.compiled import steps
from derender.posterior.compiled.contacts import touch_anew
from derender.posterior.compiled.layout import SCALE, Chain, Kernels, Model
from derender.posterior.compiled.model import held
from derender.posterior.compiled.relocate import relocate, turn
from derender.posterior.compiled.standing import stand_all
from derender.posterior.kernels import kernels
from derender.posterior.kernels.base import Part, Tuning
from derender.posterior.kernels.drift import directions_of, factor_of
from derender.posterior.kernels.flip import flips_of
from derender.posterior.kernels.relocate import mixture_of
from derender.posterior.kernels.slide import marginal_factor
from derender.scene.contacts.compiled import FEATURE_CODES


def kernels_of(target, parts: list[Part], tuning: Tuning, readable: frozenset[int],
               places: Mapping[int, np.ndarray], addresses: "Addresses") -> Kernels:  # fmt: skip
    """Return the mixture's arrays.

    readable : numbers of the kernels without a compiled form. places : see `places_seen`.
    """
    space, names = target.space, target.template.names
    table, numbers, members, factors = [], [], [], []
    weight = 0.0
    first = factor_first = 0
    for k, part in enumerate(parts):
        kind = kernels[part.type]
        code = steps.READABLE if k in readable else kind.code
        scale, count, reach, factor = 1.0, 0.0, 0.0, np.empty(0)
        moved: list[int] = list(part.block.unknowns)
        if kind.code == steps.DRIFT:
            fit = marginal_factor if kind.keeps_children else factor_of
            factor = fit(tuning.covariance, directions_of(space, part.block))
            scale = scale_of(space, part, tuning)
        elif kind.code in steps.PLACING:
            rows = objects_below(target, part.block.objects)
            moved = [*rows[0, 1:3], *rows[:, 0], *rows[:, 3]]
            factor = places[k]
        elif kind.code == steps.INDEPENDENCE:
            factor = part.options["inflation"] * np.linalg.cholesky(tuning.covariance)
        elif kind.code == steps.WINDOW:
            count, reach = float(int(part.options["count"])), part.options["reach"]
        elif kind.code == steps.FLIP:
            moved = [unknown for triple in flips_of(space) for unknown in triple]
        weight += part.weight
        keep = names.index(part.block.objects[0]) if kind.keeps_children else -1
        proposes = {steps.RELOCATE: addresses.relocate, steps.TURN: addresses.turn}.get(
            kind.code or 0, addresses.propose
        )
        table.append((code, first, factor_first, keep, proposes, addresses.keep))
        numbers.append((weight, scale, count, reach))
        members += moved
        factors.append(np.ravel(factor))
        first += len(moved)
        factor_first += factor.size
    return Kernels(
        table=np.ascontiguousarray(np.array([*table, (0, first, factor_first, -1, 0, 0)], np.int64).T),
        numbers=np.array(numbers, float),
        members=np.array(members, np.int64),
        factors=np.concatenate(factors),
        spread=np.array(space.scales),
        mean=np.array(tuning.mean, float),
    )


class Addresses(NamedTuple):
    """Where the kernels of steps lie in this process; 0: not asked for."""

    propose: int = 0
    relocate: int = 0
    turn: int = 0
    keep: int = 0


def addresses_of(parts: list[Part], model: Model, chain: Chain) -> Addresses:
    """Compile what a mixture's steps call and return where it lies."""
    types = [kernels[part.type] for part in parts]
    rng, index, flat, members = np.random.default_rng(), np.int64(0), np.zeros(1), np.zeros(1, np.int64)
    relocate_at = turn_at = keep_at = 0
    placing = (rng, model.vertices, model.laws, chain.numbers, chain.pose, chain.relative, chain.moved_pose, members,
               index, index, members, flat)  # fmt: skip
    if any(kind.code == steps.RELOCATE for kind in types):
        relocate_at = address_of(relocate, *placing)
    if any(kind.code == steps.TURN for kind in types):
        turn_at = address_of(turn, *placing)
    if any(kind.keeps_children for kind in types):
        keep_at = address_of(touch_anew, model.vertices, model.extents, model.places, model.laws, chain.values,
                             chain.numbers, chain.pose, chain.marks, flat, chain.relative, index, members,
                             chain.moved_pose)  # fmt: skip
    propose_at = address_of(steps.propose, rng, model.unknowns, model.laws, chain.values, chain.tangents, members, flat,
                            index, 0.0, flat, flat)  # fmt: skip
    return Addresses(propose_at, relocate_at, turn_at, keep_at)


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
    chosen = {k: part.block.objects for k, part in enumerate(parts) if kernels[part.type].code in steps.PLACING}
    if not chosen:
        return {}
    objects = sorted({name for names in chosen.values() for name in names})
    places = np.empty((len(objects), len(archive), 3))
    stand_all(model, chain, np.ascontiguousarray(archive, float), objects_below(target, objects).T.copy(), places)
    return {k: mixture_of(target, names, dict(zip(objects, places, strict=True))).flat() for k, names in chosen.items()}


def scale_of(space, part: Part, tuning: Tuning) -> float:
    """Return the step scale of a drifting kernel."""
    return part.options["scale"] * tuning.scale.get(part.name, 1.0) * 2.4 / np.sqrt(space.size(part.block))


def rescaled(target, parts: list[Part], tuning: Tuning, program: Kernels) -> Kernels:
    """Return the arrays of a tuning that differs in its scales alone: a tenth of the time to make them anew."""
    changed = program.numbers.copy()
    for k, part in enumerate(parts):
        if kernels[part.type].code == steps.DRIFT:
            changed[k, SCALE] = scale_of(target.space, part, tuning)
    return program._replace(numbers=changed)


def readable_parts(target, parts: list[Part]) -> frozenset[int]:
    """Return the numbers of the kernels that have to take their steps as they stand.

    They have no compiled form, or move a number that compiled steps cannot change.
    """
    kept = set(held(target).values())
    moved = [{target.space.offsets[i] for i in kernels[part.type].moves(target.space, part.block)} for part in parts]
    return frozenset(k for k, part in enumerate(parts) if kernels[part.type].code is None or moved[k] & kept)
