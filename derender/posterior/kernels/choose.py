"""Choose: another value of a discrete unknown, such as the face that an object stands on."""

from derender.posterior.kernels.base import KernelType, decide, evaluate, kernels


class Choose:
    """One discrete unknown of the block takes another of its n values, each with probability 1 / (n - 1).

    Which unknown, and which of its other values, have the same probabilities on the way back:
    log ratio = log posterior(new) - log posterior(old).
    """

    def __init__(self, target, block, temperature=1.0):
        self.target, self.temperature = target, temperature
        self.discrete = choices_of(target.space, block)
        self.name = f"choose {block.name}"

    def __call__(self, rng, state):
        space = self.target.space
        unknown = self.discrete[int(rng.random() * len(self.discrete))]
        at = space.offsets[unknown]
        count = len(space.unknowns[unknown].distribution.choices)
        other = int(rng.random() * (count - 1))
        values = state.values.copy()
        values[at] = other if other < values[at] else other + 1
        return decide(rng, state, evaluate(self.target, values), 0.0, self.temperature, self.name)


def choices_of(space, block) -> list[int]:
    """Return the block's discrete unknowns with more than one value."""
    return [i for i in block.unknowns if len(getattr(space.unknowns[i].distribution, "choices", ())) > 1]


@kernels.register("choose")
class ChooseType(KernelType):
    """Take another value of a discrete unknown of a target in Python; a scene's open faces are structures instead."""

    def applies(self, space, block):
        return bool(choices_of(space, block))

    def moves(self, space, block):
        return choices_of(space, block)

    def build(self, target, block, tuning, options):
        return Choose(target, block, tuning.temperature)
