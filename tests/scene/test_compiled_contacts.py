"""The compiled contacts against the readable ones."""

import math

import numpy as np
import pytest
from geometry import all_choices, random_body

from derender.scene.contacts import compiled, contacts
from derender.scene.pose import compose, random_rotation
from derender.scene.shapes import shapes

KINDS = [name for name in contacts if contacts[name].compiled_code is not None]


def arguments(body):
    size, kind = body.size(), body.shape.solid_kind
    return compiled.FRAME if kind is None else kind, np.zeros(3) if size is None else size


def random_phi(rng, parameters):
    phi = np.zeros(compiled.SLOTS)
    for place, p in enumerate(parameters):
        low, high = (p.lower, p.upper) if math.isfinite(p.lower) else (-0.2, 0.2)
        phi[place] = rng.uniform(low, high)
    return phi


def cases(rng, kind):
    for _, first, second, parent_face, child_face in all_choices(types=[kind]):
        parent, child = random_body(rng, first), random_body(rng, second)
        faces = compiled.FEATURE_CODES[parent_face], compiled.FEATURE_CODES[child_face]
        code = contacts[kind].compiled_code
        yield (parent, child, parent_face, child_face), (code, *arguments(parent), *arguments(child), *faces)


def test_every_built_in_type_and_feature_has_a_code():
    assert set(KINDS) == {"6dof", "face-to-face", "point-on-face", "side-on-face", "edge-on-face", "corner-on-face"}
    codes = [contacts[kind].compiled_code for kind in KINDS]
    assert sorted(codes) == list(range(len(codes)))
    for name in ("box", "cube", "cylinder", "sphere", "plane", "frame", "mesh"):
        assert all(feature in compiled.FEATURE_CODES for feature in shapes[name].feature_names())


@pytest.mark.parametrize("kind", KINDS)
def test_forward(kind):
    rng = np.random.default_rng(1)
    out = np.empty((4, 4))
    for readable, flat in cases(rng, kind):
        parameters = contacts[kind].parameters(readable[0].shape, readable[1].shape, *readable[2:])
        phi = random_phi(rng, parameters)
        names = [p.name for p in parameters]
        expected = contacts[kind].relative_pose(dict(zip(names, phi, strict=False)), *readable)
        compiled.relative_pose(*flat, phi, out)
        assert np.abs(out - expected).max() < 1e-12


@pytest.mark.parametrize("kind", KINDS)
def test_inverse_of_any_pose(kind):
    rng = np.random.default_rng(2)
    phi = np.zeros(compiled.SLOTS)
    for readable, flat in cases(rng, kind):
        pose = random_rotation(rng)
        pose[:3, 3] = rng.uniform(-0.1, 0.1, 3)
        expected = contacts[kind].invert(pose, *readable)
        outside, angle = compiled.invert(*flat, pose, phi)
        parameters = contacts[kind].parameters(readable[0].shape, readable[1].shape, *readable[2:])
        values = [expected.values[p.name] for p in parameters]
        # Where two angles nearly share an axis, and near half turns, rounding of 1e-16 grows by their small distance.
        assert np.abs(phi[: len(values)] - values).max() < 1e-9
        assert outside == pytest.approx(expected.outside, abs=1e-12)
        assert angle == pytest.approx(expected.angle, abs=1e-7)


def test_compose_is_the_matrix_product():
    rng = np.random.default_rng(4)
    first, second, out = random_rotation(rng), random_rotation(rng), np.empty((4, 4))
    first[:3, 3], second[:3, 3] = rng.standard_normal((2, 3))
    compose(first, second, out)
    assert np.abs(out - first @ second).max() < 1e-14


def test_a_wrong_chart_is_seen():
    """Broken twin: a lying cylinder placed by the chart of flush faces differs as soon as it rolls."""
    rng = np.random.default_rng(5)
    out, wrong = np.empty((4, 4)), np.empty((4, 4))
    _, flat = next(cases(rng, "side-on-face"))
    phi = np.array([0.3, 0.4, 0.5, 0.0, 0.2, 0.3, 0.0])
    compiled.relative_pose(*flat, phi, out)
    compiled.relative_pose(compiled.FACE_TO_FACE, *flat[1:], phi, wrong)
    assert np.abs(out - wrong).max() > 1e-2
