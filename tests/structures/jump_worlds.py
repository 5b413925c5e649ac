"""Priors over few objects in which every jump has something to do: where jumps are proved."""

import numpy as np

from derender.document import document_from
from derender.scene.codec.yaml_tree import parse_yaml
from derender.structures.jumps.base import evaluate
from derender.structures.jumps.run import Draws, walk

# Shapes of every kind, standing and lying, on a floor and on each other; sizes free, one known.
GRAMMAR = """
derender: 1
root: {position: [0, 0.05, 0.6], quat_wxyz: [0.5, -0.866025403784438647, 0, 0]}
objects:
  floor: {shape: plane, contact: {type: 6dof}}
structure:
  type: grammar
  offspring: {floor: {categorical: {0: 0.3, 1: 0.4, 2: 0.3}}, box: {categorical: {0: 0.6, 1: 0.4}},
              cube: {categorical: {0: 0.6, 1: 0.4}}, cylinder: {categorical: {0: 0.7, 1: 0.3}}}
shapes:
  cube: {side: {uniform: [0.03, 0.09]}}
  box: {weight: 2, length: {uniform: [0.03, 0.1]}, width: {uniform: [0.03, 0.1]}, height: {uniform: [0.02, 0.1]}}
  cylinder: {radius: {uniform: [0.015, 0.05]}, height: {uniform: [0.02, 0.1]}}
  sphere: {weight: 0.5, radius: {uniform: [0.02, 0.04]}}
contacts:
  standing: {type: face-to-face, parent_face: top, x: {normal: [0, 0.06]}, y: {normal: [0, 0.06]}, weight: 3,
             u: {uniform: [0.2, 0.8]}}
  lying: {type: side-on-face, parent_face: top, x: {normal: [0, 0.06]}, y: {normal: [0, 0.06]}}
  rolling: {type: point-on-face, parent_face: top, x: {normal: [0, 0.06]}, y: {normal: [0, 0.06]}}
"""

# The paper's Algorithm 1, parents that float and children on any of their faces.
ALGORITHM_1 = """
derender: 1
structure: {type: algorithm-1, mean_parents: 1.5, mean_children: 1.0}
shapes:
  cube: {side: {uniform: [0.05, 0.12]}}
  box: {length: {uniform: [0.04, 0.14]}, width: {uniform: [0.04, 0.14]}, height: {uniform: [0.04, 0.14]}}
contacts:
  6dof: {position: [{uniform: [-0.05, 0.05]}, {uniform: [-0.05, 0.05]}, {uniform: [0.6, 0.7]}],
         quat_wxyz: uniform-rotation}
  face-to-face: {}
"""

# Solids that float over a floor or stand on it, with a prior on how badly contacts hold, and one of known size.
SLACK = """
derender: 1
root: {distance: {uniform: [0.5, 0.8]}, elevation: {uniform: [20 deg, 60 deg]}}
objects:
  floor: {shape: plane, contact: {type: 6dof}}
structure:
  type: grammar
  offspring: {root: {categorical: {0: 0.5, 1: 0.5}}, floor: {categorical: {0: 0.3, 1: 0.4, 2: 0.3}},
              box: {categorical: {0: 0.5, 1: 0.5}}}
shapes:
  box: {length: {uniform: [0.03, 0.1]}, width: {uniform: [0.03, 0.1]}, height: {uniform: [0.03, 0.1]}}
  known: {type: cube, side: 0.06}
contacts:
  6dof: {position: [{uniform: [-0.1, 0.1]}, {uniform: [-0.1, 0.1]}, {uniform: [0.0, 0.2]}], quat_wxyz: uniform-rotation}
  standing: {type: face-to-face, parent_face: top, x: {normal: [0, 0.06]}, y: {normal: [0, 0.06]},
             gap: {normal: [0, 0.005]}, tilt_x: {normal: [0, 0.05]}, tilt_y: {normal: [0, 0.05]}}
"""

# Blocks nearly alike and nearly flush, in which solids often merge and change their parents.
BLOCKS = """
derender: 1
root: {position: [0, 0.05, 0.6], quat_wxyz: [0.5, -0.866025403784438647, 0, 0]}
objects:
  floor: {shape: plane, contact: {type: 6dof}}
structure:
  type: grammar
  offspring: {root: {categorical: {0: 0.5, 1: 0.5}}, floor: {categorical: {0: 0.2, 1: 0.4, 2: 0.4}},
              box: {categorical: {0: 0.5, 1: 0.5}}}
shapes:
  box: {length: {uniform: [0.08, 0.1]}, width: {uniform: [0.08, 0.1]}, height: {uniform: [0.005, 0.06]}}
contacts:
  6dof: {position: [{uniform: [-0.02, 0.02]}, {uniform: [-0.02, 0.02]}, {uniform: [0.0, 0.04]}],
         quat_wxyz: uniform-rotation}
  lower: {type: face-to-face, parents: [plane], parent_face: +z, child_face: -z, x: {normal: [0, 0.02]},
          y: {normal: [0, 0.02]}, gap: {normal: [0, 0.02]}, tilt_x: {normal: [0, 0.2]}, tilt_y: {normal: [0, 0.2]}}
  upper: {type: face-to-face, parents: [box], parent_face: top, child_face: -z, u: {beta: [20, 20]},
          v: {beta: [20, 20]}, gap: {normal: [0, 0.03]}, theta: {uniform: [-10 deg, 10 deg]}}
"""

# Long and thin boxes that touch anywhere up to their rims: area elements differ much from face to face.
RIMS = """
derender: 1
root: {position: [0, 0.05, 0.6], quat_wxyz: [0.5, -0.866025403784438647, 0, 0]}
objects:
  floor: {shape: plane, contact: {type: 6dof}}
structure: {type: grammar, offspring: {floor: {categorical: {1: 1}}, box: {categorical: {0: 0.5, 1: 0.5}}}}
shapes:
  box: {length: {uniform: [0.01, 0.3]}, width: {uniform: [0.01, 0.3]}, height: {uniform: [0.01, 0.3]}}
contacts:
  any: {type: face-to-face, parent_face: top, x: {normal: [0, 0.1]}, y: {normal: [0, 0.1]}}
"""

TEXTS = {"rims": RIMS, "blocks": BLOCKS, "grammar": GRAMMAR, "algorithm-1": ALGORITHM_1, "slack": SLACK}


def prior_of(name: str):
    """Return the prior of one of the worlds."""
    return document_of(TEXTS[name]).prior


def document_of(text: str):
    """Return the document of a YAML text."""
    top, folder = _parsed(text)
    return document_from(top, folder)


def _parsed(text: str):
    from pathlib import Path

    return parse_yaml(text.encode(), "a test's world"), Path.cwd()


def generator(*seed: int) -> np.random.Generator:
    """Return a generator for some seeds."""
    return np.random.default_rng(list(seed))


def jump_chain(rng, target, words, start, draws, warmup, thin):
    """Return the Draws of `draws` states, `thin` steps apart, after `warmup` steps."""
    state, states = walk(rng, target, words, evaluate(target, start), warmup), []
    for _ in range(draws):
        state = walk(rng, target, words, state, thin)
        states.append(state)
    return Draws(states, {})
