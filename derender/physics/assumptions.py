"""What physics has to assume of a scene that could not be, said in sentences instead of being done in silence."""

import numpy as np

from derender.errors import DerenderError
from derender.physics.bodies import Matter
from derender.physics.materials import LEAST_MASS
from derender.physics.statics import WIDEST_GAP, WIDEST_GAP_METRES, Contacts, find_contacts, unit_of_length

# Bodies that are so many times longer than wide are needles: their verdicts hang on the last tenth of a millimetre.
NEEDLE = 200.0


def assumptions(matter: Matter, contacts: Contacts | None = None) -> list[str]:
    """Return what is assumed of a scene beyond what it says; [] where nothing is.

    Raises
    ------
    DerenderError : a pose, size, mass or speed that is no finite number.
    """
    for body in matter.bodies:
        numbers = [*np.ravel(body.pose), *body.size, body.mass or 0.0, *body.velocity, *body.angular_velocity]
        if not np.isfinite(numbers).all() or (body.kind != "plane" and np.min(body.size) <= 0):
            raise DerenderError("a number of this object is not finite or a size not positive", body.name, "give it")
    said = []
    length = unit_of_length(matter)
    deepest = max(WIDEST_GAP * length, WIDEST_GAP_METRES)
    contacts = find_contacts(matter) if contacts is None else contacts
    seen = set()
    for first, second, gap in zip(contacts.first, contacts.second, contacts.gap, strict=True):
        pair = matter.bodies[first].name, matter.bodies[second].name
        if gap < -deepest and pair not in seen:
            seen.add(pair)
            said.append(
                f"{pair[0]} and {pair[1]} overlap by {-1e3 * gap:.1f} mm: they are taken to rest as they are, but such "
                "a scene cannot be"
            )
    masses = {body.name: body.weight_in_kg() for body in matter.bodies if body.moves}
    heaviest = max(masses.values(), default=0.0)
    for name, mass in masses.items():
        if mass < LEAST_MASS * heaviest:
            said.append(f"{name} weighs {mass:.2g} kg: it is taken for {LEAST_MASS * heaviest:.2g} kg, beside the rest")
    for body in matter.bodies:
        if body.kind != "plane" and np.max(body.size) > NEEDLE * np.min(body.size):
            said.append(f"{body.name} is a needle or a leaf: what it does hangs on less than can be measured")
    if masses and not any(not body.moves for body in matter.bodies):
        said.append("there is no floor and nothing is fixed: everything falls")
    if not np.any(matter.gravity):
        said.append("there is no gravity")
    return said
