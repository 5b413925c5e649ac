"""A hundred mutated scene files: each is read, or refused in one line; never a traceback."""

import re

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from derender import data_path
from derender.document import built_in_priors, document_from, document_text
from derender.errors import DerenderError
from derender.scene.codec.yaml_tree import parse_yaml
from derender.scene.graph import SceneGraph

TEXTS = {name: data_path(f"priors/{name}.yaml").read_text() for name in built_in_priors()}
NASTY = [
    "", "~", "null", "[]", "{}", "0", "-1", "1e-3", "1.0e+300", "-1.0e-300", ".nan", ".inf", "012", "1e9",
    "1000000000",
    "on", "true", "'0.1'", '"\\x00"', "\t", "*a", "&a", "!!int 3", "!!python/object:os.system x", "[[[[[[[[",
    "}}}}", "? :",
    "root", "floor", "green", "cube", "plane", "sphere", "mesh", "frame", "6dof", "face-to-face",
    "corner-on-face", "top",
    "+z", "-z", "+q", "uniform-rotation", "{uniform: [0, 1]}", "{uniform: [1, 0]}", "{normal: [0, 1]}", "{normal: 3}",
    "{poisson: 1.0e+9}", "{poisson: 3}", "{categorical: {floor: 1, green: 1}}", "{categorical: {1: 1}}",
    "{gamma: {shape: 1}}",
    "{type: mesh, file: nowhere.ply}", "{type: cube}", "{type: sphere, radius: 0.1}", "20 deg", "3 mm",
    "5 apples", "\ud7ff",
    "[0, 0, 0]", "[0, 0, 0, 0]", "[1, 0, 0, 0]", "<<", "---", "# x", "é", "a: b: c", "- - -", "|", ">", "%YAML 9.9",
]  # fmt: skip
KEYS = [
    "derender", "camera", "root", "objects", "structure", "shapes", "contacts", "constraints", "likelihood",
    "inference",
    "made", "shape", "parent", "contact", "supports", "type", "side", "length", "theta", "u", "x", "gap", "position",
    "quat_wxyz", "weight", "parents", "offspring", "mean_parents", "distance", "elevation", "pose", "mass",
    "colour", "sigma",
    "green", "floor", "cube", "box", "fx", "width", "parent_face", "child_face", "on", "6dof", "face-to-face", "z",
]  # fmt: skip

mutation = st.one_of(
    st.tuples(st.just("token"), st.integers(0, 400), st.sampled_from(NASTY + KEYS)),
    st.tuples(st.just("token"), st.integers(0, 400), st.sampled_from(NASTY + KEYS)),
    st.tuples(st.just("token"), st.integers(0, 400), st.sampled_from(NASTY + KEYS)),
    st.tuples(st.just("value"), st.integers(0, 400), st.sampled_from(NASTY)),
    st.tuples(st.just("key"), st.integers(0, 400), st.sampled_from(KEYS)),
    st.tuples(st.just("drop line"), st.integers(0, 60), st.just("")),
    st.tuples(st.just("repeat line"), st.integers(0, 60), st.just("")),
    st.tuples(st.just("cut"), st.integers(0, 4000), st.just("")),
    st.tuples(st.just("insert"), st.integers(0, 4000), st.one_of(st.sampled_from(NASTY), st.text(max_size=4))),
    st.tuples(st.just("drop"), st.integers(0, 4000), st.just("")),
)


def mutate(text, kind, place, token):
    if kind in ("value", "key"):
        mark = ":" if kind == "key" else ": "
        spots = [i for i in range(len(text)) if text.startswith(mark, i)]
        if not spots:
            return text
        at = spots[place % len(spots)]
        if kind == "value":
            end = min([i for c in ",}]\n" if (i := text.find(c, at)) >= 0], default=len(text))
            return f"{text[:at]}: {token}{text[end:]}"
        begin = max(text.rfind(c, 0, at) for c in " {,\n") + 1
        return text[:begin] + token + text[at:]
    if kind == "token":  # a whole number or word, so that most results are YAML and get far
        words = list(re.finditer(r"[\w.+-]+(?: deg| mm)?", text))
        if not words:
            return text
        word = words[place % len(words)]
        return text[: word.start()] + token + text[word.end() :]
    if kind.endswith("line"):
        lines = text.splitlines(keepends=True) or [""]
        at = place % len(lines)
        lines[at : at + 1] = [] if kind == "drop line" else [lines[at], lines[at]]
        return "".join(lines)
    at = place % (len(text) + 1)
    return {"cut": text[:at], "insert": text[:at] + token + text[at:], "drop": text[:at] + text[at + 1 :]}[kind]


def read_everything(text, folder):
    """Read a text as far as any command would; True if nothing was wrong with it."""
    try:
        document = document_from(parse_yaml(text.encode("utf-8", "surrogatepass"), "fuzz.yaml"), folder)
        for term in getattr(document.prior, "constraints", ()):
            assert term is not None
        object.__setattr__(document.prior, "constraints", ())  # ten thousand tries of an impossible prior are not quick
        graph = document.prior.sample(np.random.default_rng(0))
        assert isinstance(graph, SceneGraph) and not np.isnan(document.prior.log_density(graph))
        document.prior.free_addresses(graph)
        likelihood = document.likelihood
        again = document_from(parse_yaml(document_text(graph, document.camera, likelihood), "again.yaml"), folder)
        assert document.prior.log_density(again.prior.sample(np.random.default_rng(0))) == document.prior.log_density(
            graph
        )
        for pose in graph.poses().values():
            assert pose.shape == (4, 4)
    except DerenderError as error:
        line = str(error)
        assert line and "\n" not in line and len(line) < 1000
        return False
    return True


@pytest.mark.parametrize("name", sorted(TEXTS))
def test_the_unmutated_files_are_right(name, tmp_path):
    assert read_everything(TEXTS[name], tmp_path)


@settings(max_examples=100, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(st.sampled_from(sorted(TEXTS)), st.lists(mutation, min_size=1, max_size=2))
def test_mutated_files_never_give_a_traceback(tmp_path_factory, name, mutations):
    text = TEXTS[name]
    for each in mutations:
        text = mutate(text, *each)
    read_everything(text, tmp_path_factory.getbasetemp())


@settings(max_examples=100, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(
    st.one_of(st.binary(max_size=200), st.text(max_size=200).map(lambda text: text.encode("utf-8", "surrogatepass")))
)
def test_garbage_never_gives_a_traceback(tmp_path_factory, data):
    try:
        document_from(parse_yaml(b"derender: 1\n" + data, "garbage"), tmp_path_factory.getbasetemp())
    except DerenderError as error:
        assert "\n" not in str(error)
