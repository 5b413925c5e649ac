"""Free-form things in a posterior: each part of it gets them as objects, with what is not known of their extents."""

from dataclasses import replace

import numpy as np

from derender.detection.closing import surface_of
from derender.detection.search.bodies import APART
from derender.detection.solids.graph import FLOOR_NAME, best_contact, names_of, vertex_of
from derender.detection.solids.image import CENTRE, SIZE
from derender.detection.solids.state import FLOOR

SLACK = ("gap", "tilt_x", "tilt_y")
HIDDEN = 0.1  # of an extent: what is not seen of a thing may reach so much farther


def thing_name(number):
    """Return the name of an Observation's thing of this number."""
    return f"thing_{number + 1}"


def with_things(rng, parts, seen, state):
    """Return StructurePosteriors with free-form things among their objects.

    seen : Observation. state : State of the solids that the search found.
    """
    if not seen.things:
        return parts
    jump = APART * seen.footprint + 3.0 * seen.sigma
    names = names_of(state)
    made = [(thing, *surface_of(seen.image, thing.mask, thing.row, jump)) for thing in seen.things]
    return [_with_all(rng, part, state, names, made, float(np.median(seen.sigma))) for part in parts]


def _with_all(rng, part, state, names, made, noise):
    graph, addresses, values, periods = part.graph, list(part.addresses), [part.values], list(part.periods)
    chains, draws, _ = part.values.shape
    best = np.unravel_index(np.argmax(part.log_density), part.log_density.shape)
    for number, (thing, surface, size, centre) in enumerate(made):
        name = thing_name(number)
        row = thing.row.copy()
        row[CENTRE:SIZE], row[SIZE:] = centre, size
        vertex = vertex_of(row, False, name)
        numbers = dict(zip(("length", "width", "height"), map(float, size), strict=True))
        options = {"surface": surface} if surface else {}
        vertex = replace(vertex, shape="thing", parameters=numbers, options=options)
        parent = FLOOR_NAME if thing.parent == FLOOR else names[thing.parent]
        if parent not in graph.names:
            parent = FLOOR_NAME
        contact = best_contact(graph.add(vertex), name, parent, row, None, "+z", "-z")
        if contact is not None:
            held = {key: x for key, x in contact.values.items() if key not in SLACK}
            exact = replace(contact, values=held)
            vertex = replace(vertex, parent=parent, contact=exact)
        graph = graph.add(vertex)
        for key, value in numbers.items():
            spread = np.hypot(noise, HIDDEN * value if key != "height" else 0.0)
            drawn = value + spread * np.abs(rng.standard_normal((chains, draws, 1)))
            drawn[best] = value
            addresses.append(f"{name}.{key}")
            values.append(drawn)
            periods.append(None)
    return replace(part, graph=graph, addresses=tuple(addresses), values=np.concatenate(values, axis=2),
                   periods=tuple(periods) if part.periods else ())  # fmt: skip
