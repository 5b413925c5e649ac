"""What a prior over scene graphs is (A.1): it samples them and gives their density under the stock measure."""

from abc import ABC, abstractmethod

import numpy as np

from derender.scene.distributions import Distribution
from derender.scene.graph import SceneGraph


class Prior(ABC):
    """A probability distribution over scene graphs.

    The stock measure is the counting measure on structures (vertices in their order, edges, shape and contact types),
    times Lebesgue measure on each free number and Haar measure of total mass one on each free rotation.  Objects are
    told apart by their place in the graph, not by their name: names never change a density.
    """

    @abstractmethod
    def sample(self, rng: np.random.Generator) -> SceneGraph:
        """Return one graph drawn from the prior."""

    @abstractmethod
    def log_density(self, graph: SceneGraph) -> float:
        """Return log p(G), -inf where the prior is zero."""

    @abstractmethod
    def free_addresses(self, graph: SceneGraph) -> dict[str, Distribution]:
        """Return the distribution of each free number given the structure of `graph`, by address.

        A free rotation is one address, ``NAME.contact.quat_wxyz``, with the distribution `uniform-rotation`.
        Fixed numbers are absent.  The product of these densities is the continuous part of p(G).
        """

    def log_orderings(self, graph: SceneGraph) -> float:
        """Return the log of the number of equally likely orders in which this prior could have listed the same objects.

        ``log_density + log_orderings`` is the density of the scene as a set of objects without an order.
        """
        return 0.0
