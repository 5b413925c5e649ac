"""A scene file as a whole: camera, scene or prior, likelihood, settings of the inference, origin.

The same YAML serves every command.  `read_document` reads it, `write_document` writes a scene back so that reading it
again gives the same floats, bit for bit.
"""

import os
import re
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from derender import __version__, data_path
from derender.atomic import write_text
from derender.camera.camera_file import read_camera
from derender.camera.intrinsics import Camera
from derender.errors import DerenderError, at_fault
from derender.registry import Parameter, suggest
from derender.scene.codec.scene_file import KEYS, read_prior
from derender.scene.codec.yaml_tree import Node, Section, parse_yaml, read_yaml, to_yaml
from derender.scene.distributions import Distribution
from derender.scene.graph import STANDARD_GRAVITY, Contact, SceneGraph, Vertex
from derender.scene.pose import from_quaternion, quaternion
from derender.scene.priors.objects import QUATERNION, ROTATION, Value, check_range, draw
from derender.scene.priors.reading import read_value
from derender.scene.priors.tree import Prior, TreePrior
from derender.scene.shapes import shapes

FORMAT = 1
TOP_KEYS = ("derender", "made", "camera", *KEYS, "likelihood", "inference")
LINES = {"objects": 2, "shapes": 1, "contacts": 1, "inference": 2}  # how deep these get a line for each entry


@dataclass(frozen=True)
class LikelihoodPrior:
    """The likelihood of a file: its type, and its parameters as numbers or distributions.

    type : registered name ("gaussian", "robust").
    values : number or distribution by parameter name; what is left out has the type's default.
    drawn : the same of a field of noise by which images are drawn, see `Correlated.field`; empty: by the density.
    """

    type: str = "gaussian"
    values: Mapping[str, Value] = field(default_factory=dict)
    drawn: Mapping[str, Value] = field(default_factory=dict)

    def sample(self, rng: np.random.Generator) -> dict[str, float]:
        """Return a number for each parameter given."""
        return {name: draw(value, rng) for name, value in self.values.items()}

    def drawn_by(self, rng: np.random.Generator) -> "LikelihoodPrior":
        """Return the same likelihood with a number for each parameter given, those of the field too."""
        return replace(
            self, values=self.sample(rng), drawn={name: draw(value, rng) for name, value in self.drawn.items()}
        )

    @property
    def fixed(self) -> dict[str, float]:
        """The parameters that are numbers."""
        return {name: value for name, value in self.values.items() if isinstance(value, int | float)}

    @property
    def means(self) -> dict[str, float]:
        """A number for each parameter given: where it is open, its prior's mean."""
        return {name: value if isinstance(value, int | float) else value.mean() for name, value in self.values.items()}

    @property
    def free(self) -> dict[str, Distribution]:
        """The distributions of the parameters that are open."""
        return {name: value for name, value in self.values.items() if isinstance(value, Distribution)}

    def with_values(self, values: Mapping[str, float]) -> "LikelihoodPrior":
        """Return the same likelihood with these numbers in place."""
        return replace(self, values={**self.values, **values})

    def to_data(self) -> dict[str, Any]:
        """Return what stands under `likelihood:`."""

        def plain(values: Mapping[str, Value]) -> dict[str, Any]:
            return {k: {v.name: list(v.parameters)} if isinstance(v, Distribution) else v for k, v in values.items()}

        return {"type": self.type, **plain(self.values), **({"drawn": plain(self.drawn)} if self.drawn else {})}


@dataclass(frozen=True)
class Document:
    """What a scene file says.

    prior : over scene graphs; one whose numbers are all fixed is a scene.
    camera : None where the file has none.
    likelihood : None where the file has none.
    inference : the raw section `inference:`, or None; the inference reads its own keys.
    made : version, seed, command and prior that the file was written with, or {}.
    file : its name, for messages.
    """

    prior: Prior
    camera: Camera | None = None
    likelihood: LikelihoodPrior | None = None
    inference: Section | None = None
    made: Mapping[str, Any] = field(default_factory=dict)
    file: str = "scene"

    @property
    def made_with(self) -> str | None:
        """The prior that the file says it was made with: a name, or the path of a file; None where it does not say."""
        name = self.made.get("prior")
        return None if name is None else name if Path(name).suffix == "" else str(Path(self.file).parent / name)

    @property
    def is_scene(self) -> bool:
        """Whether every number is fixed."""
        return isinstance(self.prior, TreePrior) and self.prior.fixed

    @property
    def graph(self) -> SceneGraph:
        """The scene graph of a file whose numbers are all fixed.

        Raises DerenderError : the file is a prior, with the address of a number that is open.
        """
        if not self.is_scene:
            raise DerenderError("this is a prior, not a scene", self.file, "draw a scene from it with derender sample")
        return self.prior.sample(np.random.default_rng(0))


def read_document(path: str | Path) -> Document:
    """Read a scene file or prior file; `-` is stdin.

    Raises DerenderError : one line with file, line, address and remedy.
    """
    if str(path) == "-":
        top, folder = parse_yaml(sys.stdin.buffer.read(), "stdin"), Path.cwd()
    else:
        top, folder = read_yaml(path), Path(path).parent
    return document_from(top, folder)


def read_documents() -> list[tuple[Document, str]]:
    """Read one or several YAML documents from stdin, such as `derender sample -n 10 -o -` writes; return their texts
    with them."""
    data = sys.stdin.buffer.read()
    pieces = [piece for piece in re.split(rb"(?m)^---[ \t]*\r?\n", data) if piece.strip()] or [data]
    names = ["stdin"] if len(pieces) == 1 else [f"stdin, document {number}" for number in range(1, len(pieces) + 1)]
    tops = [parse_yaml(piece, name) for piece, name in zip(pieces, names, strict=True)]
    return [
        (document_from(top, Path.cwd()), piece.decode("utf-8-sig")) for top, piece in zip(tops, pieces, strict=True)
    ]


def read_prior_document(name: str | Path) -> Document:
    """Read a prior file, or the built-in prior of that name ("tabletop")."""
    path, built_in = Path(name), built_in_priors()
    if str(name) in built_in and not path.is_file():  # a folder may have its name
        path = data_path(f"priors/{name}.yaml")
    elif str(name) != "-" and path.suffix not in (".yaml", ".yml") and not path.exists():
        raise DerenderError(f"no file and no built-in prior is called {str(name)!r}", remedy=suggest(name, built_in))
    return read_document(path)


def prior_as_seen_from(name: str | Path, folder: Path) -> str:
    """Return how a file in `folder` names a prior: the name of a built-in one, or a relative path."""
    return str(name) if str(name) in built_in_priors() else os.path.relpath(name, folder)


def built_in_priors() -> list[str]:
    """Return the names of the priors that ship with derender."""
    return sorted(path.stem for path in data_path("priors").glob("*.yaml"))


def document_from(top: Section, folder: Path) -> Document:
    """Return the document of a file's tree; relative paths in it start at `folder`."""
    top.allow(*TOP_KEYS)
    if "derender" not in top:
        raise top.fault("this file does not say that it is a scene", f"begin it with derender: {FORMAT}")
    if top["derender"].integer() != FORMAT:
        remedy = "take a newer derender" if top["derender"].integer() > FORMAT else f"write derender: {FORMAT}"
        raise top["derender"].fault(f"this version reads format {FORMAT}", remedy)
    made = top["made"].section().plain() if "made" in top else {}
    inference = top["inference"].section() if "inference" in top else None
    return Document(
        prior=read_prior(top, folder),
        camera=_read_camera(top["camera"], folder) if "camera" in top else None,
        likelihood=_read_likelihood(top["likelihood"]) if "likelihood" in top else None,
        inference=inference,
        made=made,
        file=top.file,
    )


def _read_camera(node: Node, folder: Path) -> Camera:
    """Read the camera: its numbers, or the name of a camera file."""
    if not node.empty:
        return read_camera(folder / node.text())
    if not isinstance(node, Section):
        raise node.fault(f"here stands {node.kind}", "write {fx: ..., fy: ..., cx: ..., cy: ..., width: ..., height: "
                         "...} or the name of a camera file, or leave camera out")  # fmt: skip
    node.allow("fx", "fy", "cx", "cy", "width", "height", "depth_scale", "gravity")
    floats = {key: node[key].number() for key in ("fx", "fy", "cx", "cy")}
    sizes = {key: node[key].integer(lower=1, upper=100_000) for key in ("width", "height")}
    scale = {"depth_scale": node["depth_scale"].number()} if "depth_scale" in node else {}
    down = {"gravity": [part.number() for part in node["gravity"].sequence(3)]} if "gravity" in node else {}
    with at_fault(node.where, always=True):
        return Camera(**floats, **sizes, **scale, **down)  # type: ignore[arg-type]


def _read_likelihood(node: Node) -> LikelihoodPrior:
    """Read a likelihood's type and parameters, each a number or a distribution."""
    from derender.render.likelihoods import likelihoods

    section = node.section()
    kind = section["type"].text(likelihoods)
    known, of_field = likelihoods[kind].known, likelihoods[kind].of_field
    section.allow("type", *known, *(["drawn"] if of_field else []))
    drawn = section["drawn"].section() if "drawn" in section else None
    if drawn is not None:
        drawn.allow(*of_field)
    return LikelihoodPrior(kind, _read_numbers(section, known), {} if drawn is None else _read_numbers(drawn, known))


def _read_numbers(section: Section, known: Mapping[str, Parameter]) -> dict[str, Value]:
    """Read the numbers or distributions of a likelihood's known parameters."""
    values = {}
    for key, item in section.items():
        if key in known:
            values[key] = read_value(item, known[key].unit)
            check_range(values[key], known[key], item)
    return values


def document_text(
    graph: SceneGraph,
    camera: Camera | None = None,
    likelihood: LikelihoodPrior | None = None,
    made: Mapping[str, Any] | None = None,
    folder: Path | None = None,
) -> str:
    """Return the YAML of a scene; mesh files are named relative to `folder` where that is given."""
    data: dict[str, Any] = {"derender": FORMAT}
    data["made"] = {"version": __version__, **(made or {})}
    if camera is not None:
        data["camera"] = {key: value for key, value in camera.to_dict().items() if (key, value) != ("depth_scale", 1.0)}
    data.update(graph_data(graph, folder))
    if likelihood is not None:
        data["likelihood"] = likelihood.to_data()
    return to_yaml(data, LINES)


def write_document(
    path: str | Path,
    graph: SceneGraph,
    camera: Camera | None = None,
    likelihood: LikelihoodPrior | None = None,
    made: Mapping[str, Any] | None = None,
) -> None:
    """Write a scene file whole or not at all."""
    write_text(path, document_text(graph, camera, likelihood, made, Path(path).parent))


def graph_data(graph: SceneGraph, folder: Path | None = None) -> dict[str, Any]:
    """Return what stands under `root:` and `objects:`."""
    data: dict[str, Any] = {"root": root_data(graph.root_pose)}
    if tuple(graph.gravity) != (0.0, 0.0, -1.0):
        data["gravity"] = [STANDARD_GRAVITY * value for value in graph.gravity]
    data["objects"] = {}
    for vertex in graph.vertices:
        entry: dict[str, Any] = {"shape": _shape_data(vertex, folder)}
        if vertex.parent != "root":
            entry["parent"] = vertex.parent
        entry["contact"] = _contact_data(vertex.contact)
        if vertex.supports:
            entry["supports"] = list(vertex.supports)
        entry.update({key: value for key, value in vertex.options.items() if key not in shapes[vertex.shape].options})
        data["objects"][vertex.name] = entry
    if graph.constraints:
        data["constraints"] = [
            {c.type: {"objects": [c.first, c.second], "margin": c.margin} if c.margin else [c.first, c.second]}
            for c in graph.constraints
        ]
    return data


def root_data(pose: np.ndarray) -> dict[str, Any]:
    """Return the root's pose as position and quaternion where that is exact to the bit, else as a matrix."""
    quat = quaternion(pose)
    if np.array_equal(from_quaternion(quat, pose[:3, 3]), pose):
        return {"position": pose[:3, 3].tolist(), QUATERNION: quat.tolist()}
    return {"pose": np.asarray(pose, dtype=float).tolist()}


def _shape_data(vertex: Vertex, folder: Path | None) -> Any:
    data: dict[str, Any] = {"type": vertex.shape, **vertex.parameters}
    for key in shapes[vertex.shape].options:
        value = vertex.options.get(key)
        if key == "file" and folder is not None:
            value = os.path.relpath(vertex.options[key], folder)
        if value is not None and (key != "hull" or not value):  # a hull is what a mesh has where its file says nothing
            data[key] = value
    return data if len(data) > 1 else vertex.shape


def _contact_data(contact: Contact) -> dict[str, Any]:
    data, values = {"type": contact.type, **contact.named_faces}, dict(contact.values)
    if any(key in values for key in ROTATION):
        data["position"] = [values.pop(key, 0.0) for key in "xyz"]
        data[QUATERNION] = [values.pop(key, float(key == "qw")) for key in ROTATION]
    data.update(values)
    return data
