"""What inference found: weighted structures, each with chains of values for its unknowns; saved to one .npz.

A part is one structure (which objects, shapes, parents and contact types): a template graph, the addresses of its
unknowns, and their draws. With a given structure there is one part; structure inference has several, whose weights are
their posterior probabilities.
"""

import json
import math
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from derender import __version__
from derender.atomic import atomic_path, check_files
from derender.camera.intrinsics import Camera
from derender.document import document_from, document_text
from derender.errors import DerenderError
from derender.json_text import misfit, parse_json
from derender.registry import suggest
from derender.results.fit import Explanation
from derender.scene.codec.yaml_tree import parse_yaml
from derender.scene.contacts import contacts
from derender.scene.graph import ROOT, SceneGraph, Vertex
from derender.scene.pose import from_axes, inverse, rotation_z
from derender.scene.priors.objects import check_range
from derender.scene.shapes import shapes

FORMAT = 2  # of posterior.npz
TOLD = ("addresses", "weight", "weight_error", "weight_interval", "periods", "extras")  # of each part, in its header
DRAWN = ("values", "log_prior", "log_likelihood", "root_pose", "apparent")  # of each draw, the last two where known
SAME = 1e-9  # metres and radians by which frames that are the same differ, by rounding
NINETY = 1.645  # standard deviations on either side of a normal mean that nine of ten lie within
# What NumPy, zipfile and our own reading raise for a file that is damaged or not ours.
UNREADABLE = (DerenderError, OSError, ValueError, KeyError, TypeError, AttributeError, IndexError, EOFError,
              NotImplementedError, OverflowError, RuntimeError, MemoryError, zipfile.BadZipFile,
              zlib.error)  # fmt: skip


@dataclass(frozen=True, repr=False)
class StructurePosterior:
    """Draws under one structure.

    addresses : P names such as "red.contact.theta"; a rotation's four are "red.contact.qw" to "qz". Those that begin
        with "root." or "likelihood." are no numbers of the graph.
    weight_interval : in which it lies with 90 %; None where nothing was said of its error.
    root_pose : (chains, draws, 4, 4) float64 where the root's pose is unknown, else None: the graph has it.
    apparent : (chains, draws, P) float64, the values of faces where the image shows them; None: as they are, or lost.
    extras : numbers and arrays worth keeping, by name (acceptance by kernel, evidence ...); `absent`, the names of what
        is no object in this structure though it is one in others that are alike.
    """

    graph: SceneGraph  # a SceneGraph with this structure; its numbers that are no unknowns are the fixed ones
    addresses: tuple[str, ...]
    values: np.ndarray  # (chains, draws, P) float64
    log_prior: np.ndarray  # (chains, draws) float64
    log_likelihood: np.ndarray  # (chains, draws) float64
    weight: float = 1.0  # posterior probability of the structure
    periods: tuple[float | None, ...] = ()  # (P,) of angles, None of other numbers; left out: as the graph has them
    root_pose: np.ndarray | None = None
    extras: Mapping[str, Any] = field(default_factory=dict)
    weight_error: float = 0.0  # its standard error
    weight_interval: tuple[float, float] | None = None
    apparent: np.ndarray | None = None

    def __post_init__(self) -> None:
        if not self.periods:
            object.__setattr__(self, "periods", tuple(map(self.graph.period, self.addresses)))
        if self.apparent is not None and self.apparent.shape != self.values.shape:  # there are other unknowns now
            object.__setattr__(self, "apparent", None)

    def __repr__(self) -> str:
        chains, draws, size = self.values.shape
        drawn = f"{chains} chains of {draws} draws of {size} numbers"
        return f"<StructurePosterior of weight {self.weight:.3f}: {', '.join(self.graph.names)}; {drawn}>"

    @property
    def arrays(self) -> dict[str, Any]:
        """What there is of each draw by name, (chains, draws, ...) float64."""
        return {name: array for name in DRAWN if (array := getattr(self, name)) is not None}

    @property
    def log_density(self) -> np.ndarray:
        """(chains, draws), log prior plus log likelihood."""
        return self.log_prior + self.log_likelihood

    def graph_at(self, chain: int, draw: int, apparent: bool = False) -> SceneGraph:
        """Return the scene of one draw. apparent : with its faces where the image shows them."""
        values = self.values if self.apparent is None or not apparent else self.apparent
        told = zip(self.addresses, values[chain, draw], strict=True)
        graph = self.graph.with_numbers({a: x for a, x in told if not a.startswith(("root.", "likelihood."))})
        return graph if self.root_pose is None else replace(graph, root_pose=self.root_pose[chain, draw])

    def likelihood_at(self, chain: int, draw: int) -> dict[str, float]:
        """Return the numbers of the likelihood that are unknown, by name, in one draw."""
        told = zip(self.addresses, self.values[chain, draw].tolist(), strict=True)
        return {a.removeprefix("likelihood."): x for a, x in told if a.startswith("likelihood.")}

    @property
    def interval(self) -> tuple[float, float]:
        """In which the weight lies with 90 %: the interval told, or what its standard error says."""
        wide = NINETY * self.weight_error
        return self.weight_interval or (max(self.weight - wide, 0.0), min(self.weight + wide, 1.0))

    def tells_of(self, name: str) -> bool:
        """Whether an object of this name shows in the structure: as one, or as what is clutter here."""
        return name in self.graph.names or name in self.extras.get("absent", ())

    @property
    def best_place(self) -> tuple[int, int]:
        """Chain and number of the draw of highest log density."""
        chain, draw = np.unravel_index(np.argmax(self.log_density), self.log_density.shape)
        return int(chain), int(draw)

    def best(self) -> tuple[SceneGraph, float]:
        """Return the scene of highest log density among the draws, and that density."""
        return self.graph_at(*self.best_place), float(self.log_density[self.best_place])

    def best_only(self) -> "StructurePosterior":
        """Return the part with its best draw alone."""
        chain, draw = self.best_place
        return self.at(np.s_[chain : chain + 1, draw : draw + 1])

    def at(self, place: Any) -> "StructurePosterior":
        """Return the part with some draws alone. place : what takes them from arrays (chains, draws, ...)."""
        return replace(self, **{name: array[place] for name, array in self.arrays.items()})

    def only(self, kept: Sequence[int]) -> "StructurePosterior":
        """Return the part with some of its numbers as unknowns alone, by their places."""
        addresses = tuple(self.addresses[k] for k in kept)
        drawn = {name: self.arrays[name][..., kept] for name in ("values", "apparent") if name in self.arrays}
        return replace(self, addresses=addresses, periods=(), **drawn)

    def scaled(self, share: float, error: float = 0.0) -> "StructurePosterior":
        """Return the same draws with a share of the weight. error : standard error of the share."""
        ends, weight = self.weight_interval, share * self.weight
        if ends is not None:
            wider = [math.hypot(share * (end - self.weight), NINETY * error * self.weight) for end in ends]
            ends = max(weight - wider[0], 0.0), min(weight + wider[1], 1.0)
        own = math.hypot(share * self.weight_error, error * self.weight)
        return replace(self, weight=weight, weight_error=own, weight_interval=ends)


@dataclass(frozen=True, repr=False)
class Posterior:
    """A posterior over scene graphs.

    parts : the structures found, any order; their weights sum to one, less what a search may have missed.
    meta : what else is worth knowing, as JSON would hold it (the camera, seconds, lost chains ...).
    explanation : what the most probable scene says of each pixel of the image, where that was worked out; a file does
        not hold it.
    """

    parts: tuple[StructurePosterior, ...]
    seed: int | None = None  # what made it
    command: str = ""  # what made it
    version: str = __version__  # of derender that did
    meta: Mapping[str, Any] = field(default_factory=dict)
    explanation: Explanation | None = None

    def __repr__(self) -> str:
        return f"<Posterior, structures: {len(self.parts)}, the best: {self.best_part!r}>"

    @property
    def best_part(self) -> StructurePosterior:
        """The most probable structure."""
        return max(self.parts, key=lambda part: part.weight)

    def best_graph(self) -> SceneGraph:
        """Return the scene of highest density under the most probable structure."""
        return self.best_part.best()[0]

    @property
    def uncertain(self) -> bool:
        """Whether its draws differ."""
        return len(self.parts) > 1 or self.best_part.log_density.size > 1

    @property
    def missed(self) -> float:
        """How probable it is that none of these structures is there: what is was missed, or not worth telling."""
        return max(1.0 - sum(part.weight for part in self.parts), 0.0)

    def check_name(self, name: str) -> None:
        """Raise DerenderError where no structure has an object of this name."""
        if not any(part.tells_of(name) for part in self.parts):
            names = {each for part in self.parts for each in (*part.graph.names, *part.extras.get("absent", ()))}
            raise DerenderError(f"no object is called {name!r}", remedy=suggest(name, names))

    def object_probability(self, name: str) -> float:
        """Return the probability that an object of this name is there: in the structures that were found, and in what
        a search may have missed as often as the prior says, see `Missed`: where it is likelier that something was,
        more was. How often a free-form thing is an object was counted over all answers.

        Raises DerenderError, as all that is asked by name: no structure has an object of this name.
        """
        self.check_name(name)
        total = sum(part.weight for part in self.parts)
        there = float(sum(part.weight for part in self.parts if part.tells_of(name)) / total) if total else 0.0
        things = {vertex.name for part in self.parts for vertex in part.graph.vertices if vertex.shape == "thing"}
        missed = 0.0 if name in things else self.meta.get("missed", 0.0)
        return there * self._existence(name)[0] * (1.0 - missed**2 * self.meta.get("wrong_if_missed", 0.0))

    def _existence(self, name: str) -> tuple[float, float]:
        """Return the probability that what the structures have by this name is an object at all, and its error."""
        known, error = self.meta.get("existence", {}).get(name, (1.0, 0.0))
        return float(known), float(error)

    def object_probability_error(self, name: str) -> float:
        """Return the standard error of that probability, from those of the weights."""
        self.check_name(name)
        there = [part.weight_error for part in self.parts if part.tells_of(name)]
        gone = [part.weight_error for part in self.parts if not part.tells_of(name)]
        known = min(float(np.linalg.norm(there)), float(np.linalg.norm(gone)))
        return float(np.hypot(known, self._existence(name)[1]))

    def parent_probability(self, name: str) -> dict[str, float]:
        """Return the probability of each parent of an object, given that it is there; the likeliest first."""
        return self._shares(name, lambda vertex: [vertex.parent])

    def support_probability(self, name: str) -> dict[str, float]:
        """Return the probability of each second support of an object, given that it is there; the likeliest first."""
        return self._shares(name, lambda vertex: vertex.supports)

    def shape_probability(self, name: str) -> dict[str, float]:
        """Return the probability of each shape type of an object, given that it is there; the likeliest first."""
        return self._shares(name, lambda vertex: [vertex.shape])

    def _shares(self, name: str, said: Callable[[Vertex], Iterable[str]]) -> dict[str, float]:
        """Return how probable each thing is that is said of an object, given that it is there; the likeliest first."""
        self.check_name(name)
        found: dict[str, float] = {}
        present = 0.0
        for part in self.parts:
            if name in part.graph.names:
                present += part.weight
                for what in said(part.graph.vertex(name)):
                    found[what] = found.get(what, 0.0) + part.weight
        return {what: p / present for what, p in sorted(found.items(), key=lambda item: -item[1])} if present else {}

    def graphs(self, rng: np.random.Generator, count: int) -> list[SceneGraph]:
        """Return `count` scenes drawn from the posterior: structures by weight, draws uniformly within.

        No draw comes a second time before all of its structure have come once: drawn with replacement they would say
        less than they hold.
        """
        return list(self._drawn(rng, count, again=True))

    def each_graph(self, rng: np.random.Generator, count: int) -> Iterator[SceneGraph]:
        """Yield scenes as `graphs` draws them, at most so many: no more where all draws of a structure have come once,
        unless it has one alone. What came again would tell nothing, and be counted as if it did."""
        return self._drawn(rng, count, again=False)

    def _drawn(self, rng: np.random.Generator, count: int, again: bool) -> Iterator[SceneGraph]:
        weights = np.array([part.weight for part in self.parts])
        chosen = rng.choice(len(self.parts), size=count, p=weights / weights.sum())
        order = [rng.permutation(part.log_density.size) for part in self.parts]
        taken = [0] * len(self.parts)
        for number in chosen:
            most = len(order[number])
            if not again and taken[number] == most > 1:
                return
            place = order[number][taken[number] % most]
            taken[number] += 1
            chain, draw = np.unravel_index(place, self.parts[number].log_density.shape)
            yield self.parts[number].graph_at(int(chain), int(draw))

    def save(self, path: str | Path) -> None:
        """Write an .npz, whole or not at all."""
        arrays: dict[str, Any] = {}
        headers = []
        for number, part in enumerate(self.parts):
            arrays |= {f"{name}_{number}": array for name, array in part.arrays.items()}
            told = {key: getattr(part, key) for key in TOLD}
            headers.append({"scene": document_text(part.graph), "objects": part.graph.names, **told})
        own = {key: getattr(self, key) for key in ("seed", "command", "version", "meta")}
        header = {"format": FORMAT, **own, "parts": headers}
        text = json.dumps(header, sort_keys=True, default=plain)
        with atomic_path(path) as temporary, open(temporary, "wb") as file:
            np.savez_compressed(file, header=np.frombuffer(text.encode(), np.uint8), **arrays)


def load(path: str | Path) -> Posterior:
    """Read a posterior.npz. DerenderError: no such file, or not one of ours."""
    path = Path(path)
    if path.is_dir():
        path = path / "posterior.npz"
    if not path.exists():
        inside = min(path.parent.glob("*/posterior.npz"), default=None)
        remedy = "derender infer IMAGE -o DIR writes one" if inside is None else f"name one, such as {inside.parent}"
        raise DerenderError("there is no posterior here", path, remedy)
    check_files(path.parent, [path.name])
    try:
        with np.load(path, allow_pickle=False) as file:
            header = parse_json(bytes(file["header"]))
            if isinstance(header, dict) and header.get("format") != FORMAT:
                raise DerenderError(f"its format is {header.get('format')!r}, this version reads {FORMAT}")
            if wrong := misfit(header, HEADER, "header"):
                raise DerenderError(f"{wrong} is not as it should be")
            if "camera" in header["meta"]:
                Camera(**header["meta"]["camera"])
            parts = []
            for number, part in enumerate(header["parts"]):
                own: dict[str, Any] = {key: part[key] for key in TOLD if key in part}
                own = {key: tuple(value) if isinstance(value, list) else value for key, value in own.items()}
                own |= {name: file[f"{name}_{number}"] for name in DRAWN if f"{name}_{number}" in file.files}
                parts.append(StructurePosterior(scene_of(part["scene"], part["objects"]), **own))
            check_parts(parts)
    except UNREADABLE as fault:
        reason = f" ({fault.what})" if isinstance(fault, DerenderError) else ""
        what = f"not a posterior written by derender{reason}"
        raise DerenderError(what, path, "give a DIR made by derender infer") from fault
    return Posterior(tuple(parts), header["seed"], header["command"], header["version"], header["meta"])


def scene_of(text: str, names: Sequence[str]) -> SceneGraph:
    """Return the scene of a text as `document_text` gives it, its objects in this order."""
    graph = document_from(parse_yaml(text, "scene"), Path.cwd()).graph
    if sorted(names) != sorted(graph.names):
        raise DerenderError("its objects are not those of its scene")
    return replace(graph, vertices=tuple(map(graph.vertex, names)))


def plain(value: Any) -> Any:
    """Return what JSON does not know as it can hold it: NumPy's numbers and arrays as Python's, paths as text."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return dict(value) if isinstance(value, Mapping) else str(value)


TURNS_SLIP = 1e-6  # by which products of a rotation's columns may miss those of unit vectors: rounding brings 1e-15
WEIGHTS_SLIP = 1e-6  # by which the weights of all structures may miss one: they are kept to 16 digits
LIKELIHOOD = {"type?": str, "drawn?": {str: float}, str: float}
# What a posterior's file says beside its arrays, as `misfit` takes it.
HEADER = {
    "seed": {int, None}, "command": {str, None}, "version": {str, None},
    "meta": {
        "camera?": dict, "camera_guessed?": bool, "clutter?": [(float, float, float, float, float)],
        "cut_short?": [(float, float, float, float, float)],
        "doubts?": [str], "existence?": {str: (float, float)}, "explained?": float, "faces?": float,
        "hanging?": [str], "hidden_expected?": {float, None}, "image?": str, "in_doubt?": [str],
        "likelihood?": LIKELIHOOD, "lost_chains?": list, "missed?": float, "noise?": float,
        "other_floors?": [{"probability": float, "plane": (float, float, float, float)}],
        "short_of_noise?": float,
        "spots?": [(float, float, float, float)],
        "structure_chains?": {"r_hat?": {float, None}, "shares?": [float]},
        "views?": [{"image": str, "pose": [(float, float, float, float)], "explained": float}],
        "wrong_if_missed?": float,
    },
    "parts": [{
        "scene": str, "objects": [str], "addresses": [str], "weight": float, "weight_error?": float,
        "weight_interval?": {(float, float), None}, "periods": [{float, None}],
        "extras": {"absent?": [str], "likelihood?": LIKELIHOOD, "log_evidence?": [float]},
    }],
}  # fmt: skip


def check_parts(parts: Sequence[Any]) -> None:
    """Refuse StructurePosteriors whose arrays do not fit each other, or whose weights are no probabilities; or none."""
    if not parts:
        raise DerenderError("it holds no structure")
    for part in parts:
        names, unknowns = set(part.graph.names), len(part.addresses)
        for address in part.addresses:
            if address.partition(".")[0] not in names | {"root", "likelihood"}:
                raise DerenderError(f"{address!r} is no number of its scene")
        if len(set(part.addresses)) < unknowns:
            raise DerenderError("an unknown stands twice")
        drawn = part.values.shape[:2]
        of_each = {"values": (unknowns,), "log_prior": (), "log_likelihood": (), "root_pose": (4, 4),
                   "apparent": (unknowns,)}  # fmt: skip
        for key, array in part.arrays.items():
            if array.shape != (*drawn, *of_each[key]) or len(drawn) < 2 or 0 in drawn:
                raise DerenderError(f"its {key} of {unknowns} unknowns have the shape {array.shape}")
            if array.dtype.kind != "f" or not np.isfinite(array).all():
                raise DerenderError("it holds numbers that are not finite")
        turns = np.eye(3) if part.root_pose is None else part.root_pose[..., :3, :3]
        if not np.allclose(turns @ np.moveaxis(turns, -1, -2), np.eye(3), atol=TURNS_SLIP):
            raise DerenderError("its root's poses are not rigid")
        for address, draws in zip(part.addresses, np.moveaxis(part.values, -1, 0), strict=True):
            name, _, number = address.partition(".")
            sizes = shapes[part.graph.vertex(name).shape].parameters if name in names else ()
            for parameter in (parameter for parameter in sizes if parameter.name == number):
                check_range(float(draws.min()), parameter, strict=True)
                check_range(float(draws.max()), parameter, strict=True)
        if len(part.periods) != unknowns:
            raise DerenderError(f"it has {len(part.periods)} periods for {unknowns} unknowns")
        if any(period is not None and not period > 0.0 for period in part.periods):
            raise DerenderError("a period is no length")
        if not 0.0 <= part.weight <= 1.0 + WEIGHTS_SLIP:
            raise DerenderError(f"a structure has the weight {part.weight!r}")
    if sum(part.weight for part in parts) > 1.0 + len(parts) * WEIGHTS_SLIP:
        raise DerenderError("the weights of its structures exceed one")


def merge_runs(posteriors: Sequence[Posterior], names: Sequence[str]) -> Posterior:
    """Return several posteriors of the same scene as one with the chains of all, cut to the shortest.

    Of each its most probable structure counts. Where runs found the floor in a bare image each for itself, and its
    solids turned so that they look the same, contacts are told in the frames of the first one.

    names : of the runs, for what is said of them.

    Raises DerenderError : their unknowns differ, one is a single scene, or two have chains in common: those of the same
    seed are no other draws, and would count twice.
    """
    parts = [posterior.best_part for posterior in posteriors]
    first = parts[0]
    for part, name in zip(parts, names, strict=True):
        if part.addresses != first.addresses:
            raise DerenderError(f"its structure or unknowns are not those of {names[0]}", name,
                                "report them one by one")  # fmt: skip
        if len(posteriors) > 1 and part.log_density.size == 1:
            raise DerenderError("it is one scene and no chains", name, "report it by itself")
    draws = min(part.values.shape[1] for part in parts)
    told: dict[bytes, str] = {}  # the run that has these draws
    for part, name in zip(parts, names, strict=True):
        chains = [chain.tobytes() for chain in part.values[:, :draws] if chain.size]
        if same := next((told[chain] for chain in chains if chain in told), None):
            raise DerenderError(f"its chains are those of {same} again: the seed is the same", name,
                                "infer it with another --seed")  # fmt: skip
        told |= dict.fromkeys(chains, name)
    runs = [as_seen_from(first, part).arrays for part in parts]
    joined: dict[str, Any] = {name: np.concatenate([run[name][:, :draws] for run in runs])
              for name in DRAWN if all(name in run for run in runs)}  # fmt: skip
    return replace(
        posteriors[0], parts=(replace(first, weight=1.0, **{"root_pose": None, "apparent": None, **joined}),)
    )


def as_seen_from(first: StructurePosterior, part: StructurePosterior) -> StructurePosterior:
    """Return a part with its contacts told in the frames of another's objects, in which nothing is seen to change.

    One run may have found the floor's origin elsewhere, and a cube a quarter turn further, which looks the same. The
    floors are taken to be one plane: by how much they differ in height and tilt is left out. Where a pose in the camera
    has addresses of its own, as that of a floor that is given, all stays as it is.
    """
    floors = [vertex.name for vertex in part.graph.vertices if vertex.shape == "plane"]
    if len(floors) != 1 or any(address.startswith(("root.", f"{floors[0]}.")) for address in part.addresses):
        return part
    turns, (floor,) = symmetric_turns(first.graph, part.graph), floors
    here, there = part.graph.poses(), first.graph.poses()
    turns[floor] = inverse(here[floor]) @ there[floor]
    turns[ROOT] = inverse(here[ROOT]) @ here[floor] @ turns[floor] @ inverse(there[floor]) @ there[ROOT]
    if all(np.allclose(turn, np.eye(4), rtol=0.0, atol=SAME) for turn in turns.values()):
        return part
    values = part.values.copy()
    for chain, draw in np.ndindex(values.shape[:2]):
        graph = part.graph_at(chain, draw)
        poses = {name: pose @ turns[name] for name, pose in graph.poses().items()}
        for vertex in first.graph.vertices:
            contact, bodies = vertex.contact, (graph.body(vertex.parent), graph.body(vertex.name))
            relative = inverse(poses[vertex.parent]) @ poses[vertex.name]
            told = contacts[contact.type].invert(relative, *bodies, contact.parent_face, contact.child_face).values
            for place, address in enumerate(part.addresses):
                name, _, key = address.partition(".contact.")
                if name == vertex.name and key:
                    values[chain, draw, place] = told[key]
    roots = None if part.root_pose is None else part.root_pose @ turns[ROOT]
    return replace(part, values=values, root_pose=roots, apparent=None)


def symmetric_turns(first: SceneGraph, graph: SceneGraph) -> dict[str, np.ndarray]:
    """Return by name the pose (4, 4) of the axes that an object of `first` has, in those of the same one of `graph`.

    Of all rotations that leave the object as it is the one that brings them nearest; the floor is elsewhere in each.
    """
    here, there, turns = graph.poses(), first.poses(), {}
    for vertex in graph.vertices:
        symmetry = vertex.body.shape.symmetry
        relative = here[vertex.name][:3, :3].T @ there[vertex.name][:3, :3]
        near = max(symmetry.rotations, key=lambda rotation: float(np.sum(rotation * relative)))
        if symmetry.axis == "z":  # and about it as it is there
            left = near.T @ relative
            near = near @ rotation_z(float(np.arctan2(left[1, 0] - left[0, 1], left[0, 0] + left[1, 1])))[:3, :3]
        turns[vertex.name] = from_axes((relative if symmetry.axis == "all" else near).T)
    return turns
