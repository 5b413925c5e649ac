"""The terms against interpenetration and floating belong to the model, and each can be switched off."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from geometry import overlaps

from derender.detection.solids.beliefs import Rules
from derender.detection.solids.image import ROW
from derender.document import document_from, read_prior_document
from derender.errors import DerenderError
from derender.render.raycast.depth import render_depth
from derender.scene.codec.yaml_tree import parse_yaml
from derender.structures.case import settings_of
from derender.structures.draws.chart import log_prior, make_chart, place_rows
from derender.structures.draws.numbers import state_of
from derender.structures.infer import infer_structure
from derender.structures.options import Options

SCENE = """derender: 1
camera: {fx: 140, fy: 140, cx: 79.5, cy: 59.5, width: 160, height: 120}
root: {distance: 0.75, elevation: 40 deg}
objects:
  floor: {shape: plane, contact: {type: 6dof}}
"""
STANDING = "{{shape: {{type: box, length: {}, width: {}, height: {}}}, parent: floor, contact: {{type: face-to-face, "
STANDING += "parent_face: +z, child_face: -z, theta: 35 deg, x: {}, y: 0.0}}}}\n"
CROSS = SCENE + "  a: " + STANDING.format(0.26, 0.05, 0.06, 0.0) + "  b: " + STANDING.format(0.05, 0.26, 0.09, 0.0)
HANGING = SCENE + "  a: " + STANDING.format(0.1, 0.07, 0.06, -0.14)
HANGING += """  b: {shape: {type: box, length: 0.1, width: 0.07, height: 0.06},
      contact: {type: 6dof, position: [0.03, 0.02, 0.15], quat_wxyz: [0.966, 0, 0, 0.259]}}
"""


def read(text):
    return document_from(parse_yaml(text.encode(), "scene.yaml"), Path("."))


def found(text, **options):
    """Return the best scene that a search explains the scene's image with."""
    document = read(text)
    clean, _ = render_depth(document.graph.solids(), document.camera, background=10.0)
    depth = clean + np.random.default_rng(1).normal(scale=0.001, size=clean.shape)
    options = Options(**{"method": "map", "seed": 3, **options})
    return infer_structure(depth, document.camera, options).best_graph()


@pytest.mark.slow
@pytest.mark.parametrize("allowed", [False, True])
def test_solids_enter_each_other_only_where_that_is_allowed(allowed):
    graph = found(CROSS, may_overlap=allowed)
    deepest = overlaps(graph.solids()).max()
    if allowed:
        sizes = sorted((np.sort(graph.body(name).size()) for name in graph.names if name != "floor"), key=np.prod)
        np.testing.assert_allclose(sizes, [(0.05, 0.06, 0.26), (0.05, 0.09, 0.26)], atol=0.003)
        assert deepest > 0.04
    else:
        assert len(graph.names) > 3 and deepest < 0.002  # one bar is cut in two by the other


@pytest.mark.slow
@pytest.mark.parametrize("allowed", [False, True])
def test_a_solid_hangs_in_the_air_only_where_that_is_allowed(allowed):
    """Nine millimetres over the floor; over a larger gap something that is not seen may stand, at a price."""
    graph = found(HANGING.replace("0.15", "0.039"), may_float=allowed)
    hanging = [vertex for vertex in graph.vertices if vertex.parent == "root" and vertex.shape == "box"]
    assert len(hanging) == allowed
    if allowed:
        np.testing.assert_allclose(hanging[0].body.size(), (0.1, 0.07, 0.06), atol=0.003)
        bottom = np.linalg.inv(graph.poses()["floor"]) @ graph.poses()[hanging[0].name]
        assert bottom[2, 3] == pytest.approx(0.039, abs=0.002)


def test_each_term_of_the_density_has_its_switch():
    for text, off in [(CROSS, {"overlap": np.inf}), (HANGING, {"floating": True})]:
        state, floor = state_of(read(text).graph)
        density = []
        for rules in (Rules(0.0015), Rules(0.0015)._replace(**off)):
            chart, values = make_chart(state, floor, rules)
            rows = np.empty((len(state), ROW))
            place_rows(chart, values, rows)
            density.append(log_prior(chart, rows))
        assert density[1] > density[0] + 1.0


def test_an_open_prior_says_what_the_search_may_do():
    tabletop, algorithm = (read_prior_document(name).prior for name in ("tabletop", "algorithm-1"))
    default, strict, loose = (settings_of(Options(prior=prior)) for prior in (None, tabletop, algorithm))
    assert (default.may_overlap, default.may_float, default.max_objects) == (False, False, 30)
    assert (strict.may_overlap, strict.may_float, strict.max_objects) == (False, False, 4)
    assert strict.shapes == ("box", "cube") and default.shapes == ("box", "cube", "cylinder", "sphere")
    assert (loose.may_overlap, loose.may_float) == (True, True)
    assert settings_of(Options(prior=tabletop, may_float=True)).may_float
    walls = SimpleNamespace(shapes={"wall": SimpleNamespace(type="plane")}, constraints=())
    with pytest.raises(DerenderError, match="no shape that can be looked for; the search knows box"):
        settings_of(Options(prior=walls))


def test_no_floating_rules_out_what_is_placed_freely():
    text = HANGING + "constraints: [no-floating]\n"
    prior = read(text).prior
    assert prior.log_density(read(HANGING).graph) == -np.inf
    assert prior.constraints[0].log_density(read(CROSS).graph) == 0.0
    with pytest.raises(DerenderError, match="no-floating takes no value"):
        read(HANGING + "constraints: [no-floating: 3]\n")
