"""Jump: an angle goes on by half its period, where a box nearly looks the same."""

from derender.posterior.kernels.base import KernelType, decide, evaluate, kernels
from derender.posterior.space import Block


class Jump:
    """Add half a period to one angle of the block, chosen at random.

    Half a period forward is half a period back, and each angle is chosen with the same probability both ways; adding a
    constant on a circle keeps lengths, so the Jacobian is one:
    log ratio = log posterior(new) - log posterior(old).
    """

    def __init__(self, target, block, temperature=1.0):
        self.target, self.block, self.temperature = target, block, temperature
        self.angles = [i for i in block.unknowns if target.space.unknowns[i].period is not None]
        self.name = f"jump {block.name}"

    def __call__(self, rng, state):
        space = self.target.space
        angle = self.angles[int(rng.random() * len(self.angles))]
        period = space.unknowns[angle].period
        values = space.move(state.values, Block("", (angle,)), (0.5 * period,))
        return decide(rng, state, evaluate(self.target, values), 0.0, self.temperature, self.name)


@kernels.register("jump")
class JumpType(KernelType):
    """Turn an object by half the period of its angle: a quarter turn for a box, an eighth for a cube."""

    code = 4

    def applies(self, space, block):
        return any(space.unknowns[i].period is not None for i in block.unknowns)

    def moves(self, space, block):
        return []  # half periods alone reach two places

    def build(self, target, block, tuning, options):
        return Jump(target, block, tuning.temperature)
