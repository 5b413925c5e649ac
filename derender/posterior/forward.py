"""Drawing scenes and observations from a document: the whole generative model, prior and likelihood."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from derender.camera.intrinsics import Camera
from derender.document import Document, LikelihoodPrior, document_text, write_document
from derender.sampling.chains import SCENES, stream
from derender.scene.graph import SceneGraph
from derender.scene.priors.reading import with_drawn_matter

WIDTH, HEIGHT = 160, 120  # of the camera where a file has none


@dataclass(frozen=True)
class Draw:
    """One draw from a document. camera, likelihood : as in the document, the likelihood's numbers drawn too."""

    graph: SceneGraph  # the scene
    camera: Camera
    likelihood: LikelihoodPrior | None
    made: Mapping[str, Any]  # seed and command
    rng: np.random.Generator  # what its image's noise comes from

    def text(self, camera: Camera | None = None) -> str:
        """Return the scene's YAML; `camera` replaces the document's."""
        return document_text(self.graph, camera or self.camera, self.likelihood, self.made)

    def write(self, path: Path, camera: Camera | None = None) -> None:
        """Write the scene's YAML, whole or not at all."""
        write_document(path, self.graph, camera or self.camera, self.likelihood, self.made)

    def write_image(self, path: Path, renderer: Any, noise: bool, camera: Camera | None = None) -> None:
        """Render and write the depth image, with noise drawn from the likelihood (Eq. 6) if `noise`."""
        from derender.camera.depth_file import write_depth

        camera = camera or self.camera
        depth, label = renderer.render_depth(self.graph.solids(), camera)
        if noise:
            depth = observe(self.rng, depth, self.likelihood)
        write_depth(path, depth, camera, dict(self.made), label)


def draw_documents(document: Document, count: int, seed: int, made: Mapping[str, Any]) -> Iterator[Draw]:
    """Yield `count` draws; draw k depends on the seed and on k alone."""
    camera = document.camera or Camera.from_field_of_view(WIDTH, HEIGHT)
    for number in range(count):
        rng = stream(seed, SCENES, number)
        graph = with_drawn_matter(document.prior.sample(rng), rng)
        likelihood = document.likelihood
        if likelihood is not None:
            likelihood = likelihood.drawn_by(rng)
        yield Draw(graph, camera, likelihood, {**made, "draw": number}, rng)


def observe(rng: np.random.Generator, depth: np.ndarray, likelihood: LikelihoodPrior | None) -> np.ndarray:
    """Return an observation (H, W) of a clean depth image, drawn from the likelihood, or as a field of noise where that
    says so; NaN stays without a return."""
    from derender.render.likelihoods import drawn_image

    told = (likelihood or LikelihoodPrior()).drawn_by(rng)
    return drawn_image(told.type, rng, depth, told.values, told.drawn)
