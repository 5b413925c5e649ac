"""Open-universe priors by the name under `structure: {type: ...}`: each reads its own keys."""

from collections.abc import Mapping

from derender.registry import Registry
from derender.scene.codec.yaml_tree import Section
from derender.scene.priors.algorithm_1 import Algorithm1Prior
from derender.scene.priors.bare_image import BareImagePrior, MayTip, read_loose
from derender.scene.priors.base import Prior
from derender.scene.priors.contacts import ContactPrior
from derender.scene.priors.grammar import GrammarPrior
from derender.scene.priors.reading import read_count
from derender.scene.priors.root import RootPrior
from derender.scene.priors.shapes import ShapePrior
from derender.scene.priors.terms import Term
from derender.scene.priors.tree import TreeObject

structures: Registry["Structure"] = Registry("structure", "derender.structures")


class Structure:
    """A kind of open-universe prior."""

    name: str

    def read(
        self,
        section: Section,
        root: RootPrior,
        objects: tuple[TreeObject, ...],
        shapes: Mapping[str, ShapePrior],
        contacts: ContactPrior,
        constraints: tuple[Term, ...],
    ) -> Prior:
        """Return the prior of a file's `structure` section, with what its other sections gave."""
        raise NotImplementedError


@structures.register("algorithm-1")
class Algorithm1(Structure):
    """`{type: algorithm-1, mean_parents: 1.5, mean_children: 2}`: lambda_1 and lambda_2."""

    def read(self, section, root, objects, shapes, contacts, constraints):
        section.allow("type", "mean_parents", "mean_children")
        if objects:
            raise section.fault("Algorithm 1 starts from the bare root", "leave objects: out, or take type: grammar")
        for name, shape in shapes.items():
            if shape.weight != 1.0:
                raise section.fault(f"the weight of {name} is not 1", "in Algorithm 1 each shape is as likely")
        means = [section[key].number(lower=1e-9, upper=1000) for key in ("mean_parents", "mean_children")]
        return Algorithm1Prior(root, shapes, contacts, *means, constraints)


@structures.register("grammar")
class Grammar(Structure):
    """`{type: grammar, offspring: {floor: {poisson: 2}, box: {geometric: 0.2}}}`: how many grow on each."""

    def read(self, section, root, objects, shapes, contacts, constraints):
        section.allow("type", "offspring")
        offspring = {name: read_count(node) for name, node in section["offspring"].section().items()}
        return GrammarPrior(root, objects, shapes, contacts, offspring, constraints)


@structures.register("bare-image")
class BareImage(Structure):
    """`{type: bare-image, offspring: {...}, slack: 1.5 mm, tipping: 0.01}`: a grammar, and what is loose about it."""

    def read(self, section, root, objects, shapes, contacts, constraints):
        loose = read_loose(section)
        offspring = {name: read_count(node) for name, node in section["offspring"].section().items()}
        terms = (*constraints, MayTip(loose.tipping))
        return BareImagePrior(root, objects, shapes, contacts, offspring, terms, loose)
