"""Resimulation: draw a block anew from its prior (the paper's section 3)."""

from derender.posterior.kernels.base import KernelType, decide, evaluate, kernels


class Resimulate:
    """Propose the block from its own prior, which knows no constraints between objects.

    proposal(new | old) = own prior(new block), so that prior and proposal cancel up to the constraints:
    log ratio = temperature * (log likelihood(new) - log likelihood(old)) + constraints(new) - constraints(old).
    """

    def __init__(self, target, block, temperature=1.0):
        self.target, self.block, self.temperature = target, block, temperature
        self.name = f"resimulate {block.name}"

    def __call__(self, rng, state):
        values = state.values.copy()
        for unknown in self.block.unknowns:
            self.target.space.resample(rng, values, unknown)
        new = evaluate(self.target, values)
        own = self.target.space.log_prior
        return decide(rng, state, new, own(state.values) - own(values), self.temperature, self.name)


@kernels.register("resimulate")
class ResimulateType(KernelType):
    """Draw one edge's contact, or one object's shape, anew from the prior."""

    code = 0

    def applies(self, space, block):
        return bool(block.unknowns)

    def moves(self, space, block):
        return block.unknowns

    def build(self, target, block, tuning, options):
        return Resimulate(target, block, tuning.temperature)
