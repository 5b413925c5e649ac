"""Small scenes with images, for the tests of inference."""

import numpy as np

from derender.document import document_from
from derender.posterior.target import ObservedImage, SceneTarget
from derender.render.likelihoods import likelihoods
from derender.render.raycast.depth import render_depth
from derender.scene.codec.yaml_tree import parse_yaml
from derender.scene.priors.terms import total_log_density
from derender.structures.given import observed_image

CAMERA = "camera: {fx: 26, fy: 26, cx: 11.5, cy: 8.5, width: 24, height: 18}\n"
# of a scene on a floor that the camera looks down upon
OPENING = (
    "derender: 1\n"
    + CAMERA
    + "root: {distance: 0.7, elevation: 30 deg}\nobjects:\n  floor: {shape: plane, contact: {type: 6dof, z: -0.1}}\n"
)

TOWER = (
    OPENING
    + """
  low:
    shape: {type: box, length: {uniform: [0.08, 0.2]}, width: {uniform: [0.08, 0.2]}, height: 0.1}
    parent: floor
    contact: {type: face-to-face, theta: {uniform: [0, 180 deg]}, x: {normal: [0, 0.05]}, y: {normal: [0, 0.05]}}
  high:
    shape: {type: cube, side: {log-normal: [0.09, 0.1]}}
    parent: low
    contact: {type: face-to-face, theta: {uniform: [0, 90 deg]}, u: {uniform: [0, 1]}, v: {uniform: [0, 1]}}
  top:
    shape: {type: cube, side: 0.06}
    parent: high
    contact: {type: face-to-face, theta: {uniform: [0, 90 deg]}, u: {uniform: [0.3, 0.7]}, v: {uniform: [0.3, 0.7]}}
likelihood: {type: gaussian, sigma: 0.05, blur: 0.7, background: 1.5}
"""
)

LOOKED_AT = (
    "derender: 1\n"
    + CAMERA
    + """
root: {distance: {uniform: [0.6, 0.8]}, elevation: {uniform: [20 deg, 40 deg]}, azimuth: {uniform: [0, 360 deg]}}
objects:
  floor: {shape: plane, contact: {type: 6dof, z: -0.1}}
  can:
    shape: {type: cylinder, radius: {uniform: [0.03, 0.08]}, height: {uniform: [0.08, 0.2]}}
    parent: floor
    contact: {type: face-to-face, x: {normal: [0, 0.05]}, y: {normal: [0, 0.05]}}
  ball:
    shape: {type: sphere, radius: 0.05}
    parent: can
    contact: {type: point-on-face, u: {uniform: [0, 1]}, v: {uniform: [0, 1]}}
likelihood: {type: gaussian, sigma: {log-uniform: [0.02, 0.2]}, blur: 0.7, background: 1.5}
"""
)

FLOATING = (
    "derender: 1\n"
    + CAMERA
    + """
root: {position: [0, 0, {uniform: [0.6, 0.9]}], quat_wxyz: {uniform-rotation: []}}
objects:
  box:
    shape: {type: box, length: 0.2, width: 0.12, height: 0.08}
    contact: {type: 6dof, x: {normal: [0, 0.05]}, y: 0.0, z: 0.0, quat_wxyz: {uniform-rotation: []}}
likelihood: {type: gaussian, sigma: 0.05, background: 1.5}
"""
)

# Every kind of constraint: two boxes on a floor that must not meet, one end of a deck on each.
BOUND = (
    OPENING
    + """
  left:
    shape: {type: box, length: 0.08, width: 0.1, height: {uniform: [0.06, 0.1]}}
    parent: floor
    contact: {type: face-to-face, x: {normal: [-0.08, 0.03]}, y: 0.0, theta: {uniform: [-20 deg, 20 deg]}}
  right:
    shape: {type: cylinder, radius: {uniform: [0.03, 0.05]}, height: {uniform: [0.06, 0.1]}}
    parent: floor
    contact: {type: face-to-face, x: {normal: [0.08, 0.03]}, y: {normal: [0, 0.02]}}
  deck:
    shape: {type: box, length: 0.3, width: 0.08, height: 0.03}
    parent: left
    supports: [right]
    contact: {type: face-to-face, theta: {uniform: [-10 deg, 10 deg]}, u: {uniform: [0.5, 0.9]}, v: 0.5}
constraints: [no-overlap: {depth: 5 mm, scale: 10 mm}, does-not-touch: {objects: [left, right], margin: 2 cm},
              rests-on: {objects: [deck, right], slack: 2 mm}, no-floating, at-most: 3]
likelihood: {type: gaussian, sigma: 0.4, blur: 0.7, background: 1.5}
"""
)

SCENES = {"tower": TOWER, "looked-at": LOOKED_AT, "floating": FLOATING, "bound": BOUND}


def read(text: str):
    """Return the document of a text."""
    from pathlib import Path

    return document_from(parse_yaml(text.encode(), "test.yaml"), Path("."))


class SceneWorld:
    """A document as a world for the invariance test: draws an image given the values."""

    def __init__(self, text: str) -> None:
        self.document = read(text)
        self.likelihood = self.document.likelihood
        self.unknown = self.likelihood.free
        self.template = self.document.prior.sample(np.random.default_rng(0))
        blank = np.zeros((self.document.camera.height, self.document.camera.width))
        self.blank = self._target(blank)
        self.space = self.blank.space

    def sample(self, rng) -> np.ndarray:
        """Return values from the whole prior, its constraints too, by rejection."""
        while True:
            values = self.space.sample(rng)
            if np.log(rng.random()) < total_log_density(self.blank.constraints, self.blank.graph(values)):
                return values

    def _target(self, image) -> SceneTarget:
        images: ObservedImage = observed_image(image, self.document.camera, self.likelihood)
        return SceneTarget(self.document.prior, self.template, images, self.unknown)

    def target(self, rng, values) -> SceneTarget:
        """Return the target of an image drawn given the values."""
        graph = self.blank.graph(values)
        numbers = dict(self.blank.images.values)
        for address, value in self.blank.by_address(values).items():
            if address.startswith("likelihood."):
                numbers[address.removeprefix("likelihood.")] = value
        depth = render_depth(graph.solids(), self.document.camera)[0]
        image = likelihoods[self.likelihood.type].sample(rng, depth, numbers)
        target = self._target(image)
        quarters = image[:16, :24].reshape(2, 8, 2, 12).mean(axis=(1, 3)).ravel()
        target.summary = lambda: quarters
        return target
