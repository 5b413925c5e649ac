"""What is done to a scene from outside: pushes, shaking, tilting, jitter; and how it is written (`red:+x:0.5N@0.1s`).

Jitter is perceptual noise: where bodies are, as somebody sees them who knows that solids do not enter each other, and
which rest on which.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from derender.errors import DerenderError, at_fault
from derender.physics.bodies import Body, Matter
from derender.physics.statics import deep_overlaps, find_contacts
from derender.registry import suggest
from derender.scene.codec.yaml_tree import parse_number
from derender.scene.pose import from_axes, from_rotation_vector, moved

TRIES = 10  # of noise as it comes, before it is walked to
WALK = 10  # steps of that, after which where it began does not matter
TURN, LEAST_TURN = 2.0 * np.pi, 1e-6  # radians of a step's ellipse, and those left of it at which a step stays in place
OPENS = 1e-4  # of the smallest extent, by which the points of a contact may open: a rounding of faces and normals
LEAST_SIDEWAYS = 1e-3  # of a direction of length 1: less is upright but for rounding


def jittered(matter: Matter, spread: tuple[float, float], rng: np.random.Generator) -> Matter:
    """Return a scene whose moving bodies are displaced and turned by normal noise, given that what touches goes on
    touching (`slides`) and that none enters another.

    Those that enter each other deep (`deep_overlaps`) as they are given may go on doing so. Where the noise is drawn in
    vain it is walked to from none by elliptical slice sampling (Murray, Adams, MacKay 2010).

    spread : (metres, radians) of each axis.
    """
    along, allowed = slides(matter, spread), pairs_entered(matter)

    def noisy(noise: Any) -> Matter:
        changes = (along @ noise).reshape(-1, 6)
        bodies = [body._replace(pose=moved(body.pose, change)) if body.moves else body
                  for body, change in zip(matter.bodies, changes, strict=True)]  # fmt: skip
        return matter._replace(bodies=tuple(bodies))

    for _ in range(TRIES):
        drawn = noisy(rng.normal(size=len(along)))
        if pairs_entered(drawn) <= allowed:
            return drawn
    held, drawn = np.zeros(len(along)), matter
    for _ in range(WALK):
        other, angle = rng.normal(size=len(held)), rng.uniform(0.0, TURN)
        low, high = angle - TURN, angle
        while high - low > LEAST_TURN:
            tried = np.cos(angle) * held + np.sin(angle) * other
            if pairs_entered(found := noisy(tried)) <= allowed:
                held, drawn = tried, found
                break
            low, high = (angle, high) if angle < 0.0 else (low, angle)
            angle = rng.uniform(low, high)
    return drawn


def slides(matter: Matter, spread: tuple[float, float]) -> np.ndarray:
    """Return (6 N, 6 N), by which standard normal numbers become shifts and turns of all N bodies with these deviations
    given that, to first order, what touches stays at its distance but for OPENS.

    spread : (metres, radians) of each axis of a moving body.
    """
    deviations = np.array([np.repeat(spread, 3) if body.moves else np.zeros(6) for body in matter.bodies]).ravel()
    first, second, point, normal, _ = find_contacts(matter)
    apart = np.zeros((len(point), len(matter.bodies), 6))  # metres by which a contact opens, for each shift and turn
    for sign, bodies in ((1.0, first), (-1.0, second)):
        arm = point - np.array([matter.bodies[k].pose[:3, 3] for k in bodies]).reshape(-1, 3)
        apart[np.arange(len(point)), bodies] += sign * np.concatenate([normal, np.cross(arm, normal)], axis=1)
    rows = apart.reshape(len(point), -1) * deviations
    values, vectors = np.linalg.eigh(rows.T @ rows)
    return deviations[:, None] * vectors / np.sqrt(1.0 + values.clip(0.0) / (OPENS * matter.unit) ** 2)


def pairs_entered(matter: Matter) -> set[tuple[str, str]]:
    """Return the names of the pairs of solids that enter each other deep."""
    return {(pair.first, pair.second) for pair in deep_overlaps(matter, find_contacts(matter))}


class Push(NamedTuple):
    """A force on a body's centre of mass."""

    body: str  # its name
    force: np.ndarray  # (3,) newtons in the frame of the scene
    start: float = 0.0  # seconds
    duration: float = 0.1


class Shake(NamedTuple):
    """A floor that swings to and fro: its place is amplitude * (1 - cos(2 pi frequency t)) along a direction."""

    frequency: float  # 1 / s
    amplitude: float  # metres, half of what the floor travels
    direction: np.ndarray  # (3,) unit vector
    end: float = np.inf  # seconds; then the floor keeps its speed, and seen from it nothing is done any more

    def acceleration(self, first: float, last: float) -> np.ndarray:
        """Return the floor's mean acceleration (3,) between two times: seen from it, all bodies have the opposite one.

        Its value in between would do for slow swings; of one as fast as the engine's steps the values add up to a wind.
        """
        turn = 2 * np.pi * self.frequency
        sooner, later = np.sin(turn * np.minimum((first, last), self.end))
        return self.amplitude * turn * (later - sooner) / (last - first) * np.asarray(self.direction)


def tilted(matter: Matter, angle: float, direction: np.ndarray) -> Matter:
    """Return a scene on a floor that is lowered on one side: gravity leans over towards `direction` by radians."""
    axis = np.cross(-matter.up, direction)
    length = float(np.linalg.norm(axis))
    if length < LEAST_SIDEWAYS and np.any(matter.gravity):
        raise DerenderError("a floor is not tilted up or down", "--tilt", "write 10deg:+y or 10deg:30deg")
    turned = from_rotation_vector(angle * axis / max(length, LEAST_SIDEWAYS))[:3, :3] @ matter.gravity
    return matter._replace(gravity=turned)


AXES = ("x", "y", "z")


class Intervention(NamedTuple):
    """What is done to a scene before and while it is simulated; directions are in the root's axes.

    pushes : from the start.
    remove : names of bodies taken away. add : bodies (name, kind, size (3,), what they stand on, (x, y) metres off its
        middle) each.
    tilt : (radians, direction (3,)) by which the floor is lowered, or None.
    shake : of the floor, or None.
    jitter : (metres, radians), standard deviations by which every body's place and turn is uncertain (`jittered`).
    """

    pushes: tuple[Push, ...] = ()
    remove: tuple[str, ...] = ()
    add: tuple[tuple[str, str, np.ndarray, str, tuple[float, float]], ...] = ()
    tilt: tuple[float, np.ndarray] | None = None
    shake: Shake | None = None
    jitter: tuple[float, float] | None = None

    def apply(self, matter: Matter, axes: np.ndarray, rng: np.random.Generator) -> Matter:
        """Return the scene with bodies removed, added, displaced at random, and the floor tilted.

        axes : (3, 3), whose columns are the root's axes in the frame of the scene.
        """
        names = [body.name for body in matter.bodies]
        for name in self.remove:
            if name not in names:
                raise DerenderError(f"no object is called {name!r}", None, suggest(name, names))
        bodies = [body for body in matter.bodies if body.name not in self.remove]
        supports = [pair for pair in matter.supports if not set(pair) & set(self.remove)]
        for name, kind, size, parent, place in self.add:
            if any(body.name == name for body in bodies):
                raise DerenderError(f"an object is called {name!r} already", "--add", "choose another name")
            under = next((body for body in bodies if body.name == parent), None)
            if under is None:
                raise DerenderError(f"no object is called {parent!r}", "--add", suggest(parent, names))
            bodies.append(_put_on(under, name, kind, size, place, axes))
            supports.append((name, parent))
        moves = {body.name: body.moves for body in bodies}
        for name in (push.body for push in self.pushes):
            if name not in moves:
                raise DerenderError(f"no object is called {name!r}", "--push", suggest(name, list(moves)))
            if not moves[name]:
                others = " ".join(other for other in moves if moves[other]) or "none"
                raise DerenderError(f"{name!r} does not move", "--push", f"push one that does: {others}")
        found = Matter(tuple(bodies), matter.gravity, tuple(supports))
        if self.jitter is not None:
            found = jittered(found, self.jitter, rng)
        return found if self.tilt is None else tilted(found, self.tilt[0], axes @ self.tilt[1])

    @property
    def names(self) -> set[str]:
        """Names of the bodies that it acts on."""
        added = {name for name, *_ in self.add}
        return {*(push.body for push in self.pushes), *self.remove, *(parent for *_, parent, _ in self.add)} - added

    def among(self, names: Iterable[str]) -> "Intervention":
        """Return what can be done where these bodies are: nothing to those that only other draws of a scene have."""
        there, added = set(names), []
        for each in self.add:
            if each[3] in there:
                added.append(each)
                there.add(each[0])
        pushes = tuple(push for push in self.pushes if push.body in there)
        return self._replace(
            pushes=pushes, add=tuple(added), remove=tuple(name for name in self.remove if name in there)
        )

    def in_scene(self, axes: np.ndarray, duration: float) -> "Intervention | None":
        """Return what acts on the scene while it is simulated, in the scene's own axes, for so many seconds at most."""
        if not self.pushes and self.shake is None:
            return None
        pushes = tuple(push._replace(force=axes @ push.force) for push in self.pushes)
        shake = None if self.shake is None else self.shake._replace(direction=axes @ self.shake.direction, end=duration)
        return Intervention(pushes, shake=shake)

    @property
    def ends(self) -> float:
        """Seconds after which nothing is done any more."""
        shaken = [] if self.shake is None else [self.shake.end]
        return max([*shaken, *(push.start + push.duration for push in self.pushes)], default=0.0)

    def forces(self, time: float) -> Mapping[str, np.ndarray]:
        """Return the force (3,) on each body that is being pushed at a time."""
        found: dict[str, np.ndarray] = {}
        for push in self.pushes:
            if push.start <= time < push.start + push.duration:
                found[push.body] = found.get(push.body, np.zeros(3)) + push.force
        return found


def read_push(text: str) -> Push:
    """Read NAME:DIRECTION:FORCE@TIME, such as red:+x:0.5N@0.1s."""
    parts, where = text.split(":"), f"--push {text}"
    if len(parts) != 3:
        raise DerenderError("not a push, which has three parts", where, "write NAME:+x:0.5N@0.1s")
    force, _, time = parts[2].partition("@")
    if not time:
        raise DerenderError("nothing says how long it is pushed", where, f"write {':'.join(parts[:2])}:{force}@0.1s")
    newtons = _quantity(force, "N", where) * _direction(parts[1], where)
    return Push(parts[0], newtons, 0.0, _quantity(time, "s", where, True))


def read_tilt(text: str) -> tuple[float, np.ndarray]:
    """Read ANGLE or ANGLE:DIRECTION, such as 10deg:+y; the floor sinks towards the direction, +x where none is said."""
    angle, _, way = text.partition(":")
    value = _quantity(angle, "rad", f"--tilt {text}")
    if not 0 <= value <= np.pi / 2:
        raise DerenderError(
            "the tilt is not between 0 and 90 degrees",
            f"--tilt {text}",
            "write 10deg or 10deg:-y: without a unit it is in radians",
        )
    return value, _direction(way or "+x", f"--tilt {text}")


def read_shake(text: str) -> Shake:
    """Read FREQUENCY:AMPLITUDE or with :DIRECTION, such as 2Hz:5mm:+y."""
    parts = text.split(":")
    where = f"--shake {text}"
    if len(parts) not in (2, 3):
        raise DerenderError("not a way to shake", where, "write 2Hz:5mm or 2Hz:5mm:+y")
    way = _direction(parts[2] if len(parts) == 3 else "+x", where)
    return Shake(_quantity(parts[0], "Hz", where, True), _quantity(parts[1], "m", where), way)


MOST_JITTER = 0.5  # metres and radians: nobody sees so badly, but 2 and 1 are soon written for 2mm and 1deg


def read_jitter(text: str) -> tuple[float, float]:
    """Read LENGTH or LENGTH,ANGLE, such as 2mm,1deg."""
    length, _, angle = text.partition(",")
    where = f"--jitter {text}"
    found = _quantity(length, "m", where), _quantity(angle or "0", "rad", where)
    if max(found) > MOST_JITTER:
        raise DerenderError(f"{found[0]:g} m and {found[1]:g} rad are no jitter", where, "write units, as in 2mm,1deg")
    return found


def read_add(text: str) -> tuple[str, str, np.ndarray, str, tuple[float, float]]:
    """Read NAME:SHAPE:SIZE@PARENT or with :X,Y, such as new:box:10x5x5cm@red:2cm,0."""
    where = f"--add {text}"
    remedy = "write NAME:box:10x5x5cm@PARENT, NAME:sphere:8cm@PARENT or NAME:cylinder:6x12cm@PARENT"
    head, _, tail = text.partition("@")
    parts, (parent, _, place) = head.split(":"), tail.partition(":")
    if len(parts) != 3 or not parent or parts[1] not in ("box", "cube", "sphere", "cylinder"):
        raise DerenderError("not an object to add", where, remedy)
    numbers = re.fullmatch(r"([0-9.x]+)([a-z]*)", parts[2])
    if numbers is None:
        raise DerenderError("not a size", where, remedy)
    sizes = [_quantity(each + numbers[2], "m", where) for each in numbers[1].split("x")]
    wanted = {"box": 3, "cube": 1, "sphere": 1, "cylinder": 2}[parts[1]]
    if len(sizes) != wanted or min(sizes) <= 0:
        raise DerenderError(f"a {parts[1]} has {wanted} positive size(s)", where, remedy)
    size = sizes if wanted == 3 else [sizes[0], sizes[0], sizes[-1]]
    x, _, y = place.partition(",")
    offset = (_quantity(x or "0", "m", where, signed=True), _quantity(y or "0", "m", where, signed=True))
    return parts[0], "box" if parts[1] == "cube" else parts[1], np.array(size), parent, offset


def _direction(text: str, where: str) -> np.ndarray:
    """Read +x, -y ... or an angle in the floor's plane, such as 30deg from +x towards +y."""
    if re.fullmatch(r"[+-]?[xyz]", text):
        way = np.zeros(3)
        way[AXES.index(text[-1])] = -1.0 if text[0] == "-" else 1.0
        return way
    if not re.search("[0-9]", text) or "," in text:
        raise DerenderError(f"{text!r} is no direction", where, "write +x, -y or an angle such as 30deg")
    angle = _quantity(text, "rad", where, signed=True)
    return np.array([np.cos(angle), np.sin(angle), 0.0])


MOST = 1e6  # metres, radians, newtons, seconds or hertz: what is beyond can be no more than a slip, and overflows


def _quantity(text: str, unit: str, where: str, positive: bool = False, signed: bool = False) -> float:
    """Read a number in a base unit or one of its kind (`yaml_tree.UNITS`); positive : not 0, signed : below 0 too."""
    with at_fault(where):
        value = parse_number(text, unit, strict=False)
    if (value < 0 and not signed) or (positive and value == 0):
        raise DerenderError(f"{text!r} is not {'positive' if positive else '0 or more'}", where, "such as 5 or 0.5")
    if abs(value) > MOST:
        raise DerenderError(f"{text!r} is more than can be simulated", where, "such as 5 or 0.5")
    return value


def _put_on(under: Body, name: str, kind: str, size: np.ndarray, place: tuple[float, float], axes: np.ndarray) -> Body:
    """Return a body that stands upright on the highest point of another, along the root's axes."""
    height = 0.0
    if under.kind == "mesh" and under.vertices is not None:
        height = float((under.vertices @ under.pose[:3, :3].T @ axes[:, 2]).max())
    elif under.kind == "sphere":
        height = 0.5 * float(under.size[0])
    elif under.kind != "plane":
        height = 0.5 * float(np.abs(axes[:, 2] @ under.pose[:3, :3]) @ under.size)
    middle = under.pose[:3, 3] + axes @ np.array([*place, height + 0.5 * size[2]])
    return Body(name, kind, size, from_axes(axes.T, middle))


def intervention(
    push: str | Sequence[str] = (),
    remove: str | Sequence[str] = (),
    add: str | Sequence[str] = (),
    tilt: str | None = None,
    shake: str | None = None,
    jitter: str | None = None,
) -> Intervention:
    """Return an intervention from texts: of push, remove and add one or several."""
    pushes, removed, added = ((each,) if isinstance(each, str) else tuple(each) for each in (push, remove, add))
    return Intervention(
        tuple(map(read_push, pushes)),
        removed,
        tuple(map(read_add, added)),
        None if tilt is None else read_tilt(tilt),
        None if shake is None else read_shake(shake),
        None if jitter is None else read_jitter(jitter),
    )
