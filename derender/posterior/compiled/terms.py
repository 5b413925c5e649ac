"""The prior's constraints on solids, compiled: `model.priors.terms` on a chain's own poses, number for number.

`sum_of_terms` is called by its address, and only compiled for models with constraints.
"""

import math

import numpy as np

from derender.compilation.cache import call_for_number, njit
from derender.posterior.compiled.layout import KIND, NEXT, SIZES
from derender.scene.priors.terms import AtMost, DoesNotTouch, NoFloating, NoOverlap, RestsOn
from derender.scene.separation import penetration_of, rest_residual, separation_of

OVERLAP, APART, RESTS = range(3)  # codes of terms
CODE, FIRST, SECOND, LENGTH, SCALE, PARENT, AXIS = range(7)  # columns of a term; an axis is the last three
COLUMNS = AXIS + 3


def table_of(constraints, graph) -> np.ndarray:
    """Return (T, COLUMNS) float64, one row for each pair of solids that a term is of.

    Vertices are numbered as in the graph. A hard term has the scale 0.

    Raises
    ------
    NotImplementedError : a term has no compiled form.
    """
    names = list(graph.names)
    rows: list[tuple[float, ...]] = []
    for term in constraints:
        if isinstance(term, NoOverlap):
            solids = [names.index(name) for name in graph.solid_names]
            rule = (term.depth, term.scale or 0.0, 0, 0, 0, 0)
            rows += [(OVERLAP, a, b, *rule) for a in solids for b in solids if b < a]
        elif isinstance(term, DoesNotTouch):
            first, second = term.relation.first, term.relation.second
            if first in graph.solid_names and second in graph.solid_names:
                rows.append((APART, names.index(first), names.index(second), term.least, 0, 0, 0, 0, 0))
        elif isinstance(term, RestsOn):
            parent, axis = term.bearing(graph)
            rows.append((RESTS, names.index(term.child), names.index(term.support), 0, term.slack, names.index(parent),
                         *axis))  # fmt: skip
        elif not (isinstance(term, NoFloating | AtMost) and term.log_density(graph) == 0.0):  # of structures alone
            raise NotImplementedError(term.name)
    return np.array(rows, float).reshape(-1, COLUMNS)


@njit(cache=True, nogil=True)
def log_terms(model, chain):
    """Return the terms' log density of the proposed poses and extents."""
    if model.terms_at == 0:
        return 0.0
    return call_for_number(model.terms_at, model.terms, model.vertices, chain.numbers, chain.pose)


@njit(cache=True, nogil=True)
def sum_of_terms(terms, vertices, numbers, pose):
    """Return the terms' log density of the proposed poses and extents."""
    total = 0.0
    for t in range(terms.shape[0]):
        row = terms[t]
        a, b = int(row[FIRST]), int(row[SECOND])
        kind_a, pose_a, size_a = vertices[KIND, a], pose[NEXT, a], numbers[NEXT, a, SIZES : SIZES + 3]
        kind_b, pose_b, size_b = vertices[KIND, b], pose[NEXT, b], numbers[NEXT, b, SIZES : SIZES + 3]
        if row[CODE] == OVERLAP:
            excess = penetration_of(kind_a, pose_a, size_a, kind_b, pose_b, size_b) - row[LENGTH]
            if excess > 0.0:
                if row[SCALE] == 0.0:
                    return -math.inf
                total -= 0.5 * (excess / row[SCALE]) ** 2
        elif row[CODE] == APART:
            if separation_of(kind_a, pose_a, size_a, kind_b, pose_b, size_b) <= row[LENGTH]:
                return -math.inf
        else:
            p = pose[NEXT, int(row[PARENT])]
            x = p[0, 0] * row[AXIS] + p[0, 1] * row[AXIS + 1] + p[0, 2] * row[AXIS + 2]
            y = p[1, 0] * row[AXIS] + p[1, 1] * row[AXIS + 1] + p[1, 2] * row[AXIS + 2]
            z = p[2, 0] * row[AXIS] + p[2, 1] * row[AXIS + 1] + p[2, 2] * row[AXIS + 2]
            away = rest_residual(kind_a, pose_a, size_a, kind_b, pose_b, size_b, x, y, z)
            total -= 0.5 * (away / row[SCALE]) ** 2
    return total
