"""What a film begins with is the posterior of its first frame: its mean and its spread."""

from pathlib import Path

import numpy as np

from derender.document import document_from
from derender.scene.codec.yaml_tree import parse_yaml
from derender.tracking.thing import LEAST_SPREAD, thing_of


def scene(deep):
    """Return the scene of a box whose front stands at y = 0, so many metres deep."""
    text = f"""
        derender: 1
        camera: {{fx: 150, fy: 150, cx: 79.5, cy: 59.5, width: 160, height: 120}}
        root: {{position: [0, 0.2, 0.9], quat_wxyz: [0.5, 0.866, 0, 0]}}
        objects:
          floor: {{shape: plane, contact: {{type: 6dof}}}}
          box: {{shape: {{type: box, length: 0.08, width: {deep}, height: 0.06}}, parent: floor,
                contact: {{type: face-to-face, x: 0.0, y: {deep / 2}, theta: 0.0}}}}"""
    return document_from(parse_yaml(text, "scene.yaml"), Path(".")).graph


def test_a_thing_begins_at_the_mean_of_the_draws_not_where_the_likeliest_scene_has_it():
    """How deep a box is of which the front shows, the likeliest scene said wrongly by centimetres, and the spread was
    that about the mean: a box was 9 mm off for a whole film, by seventeen standard deviations."""
    depths = np.random.default_rng(0).uniform(0.04, 0.12, 40)
    thing = thing_of(scene(0.119), [scene(deep) for deep in depths], "box")
    about = thing_of(scene(depths.mean()), [], "box")
    np.testing.assert_allclose(thing.size, about.size, atol=1e-6)
    np.testing.assert_allclose(thing.pose, about.pose, atol=1e-6)
    deviations = np.sqrt(np.diag(thing.covariance))
    assert np.isclose(deviations[6:].max(), np.std(depths, ddof=1), rtol=0.01)
    assert np.isclose(np.linalg.norm(deviations[:3]), np.std(depths, ddof=1) / 2, rtol=0.01)
    assert np.isclose(deviations[6:].min(), LEAST_SPREAD[2], rtol=0.01)
