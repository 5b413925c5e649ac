"""Flip: a box turns by a quarter and exchanges its length and width, which leaves it where it is."""

from derender.posterior.kernels.base import KernelType, decide, evaluate, kernels
from derender.posterior.space import wrap


class Flip:
    """theta -> theta + pi/2 (half its period), length <-> width, of one box chosen at random.

    An involution (twice half a period is none, exchanging twice is nothing) that permutes coordinates of one unit and
    shifts an angle: its Jacobian is one.
    log ratio = log posterior(new) - log posterior(old); on a plane the likelihoods are equal.
    """

    name = "flip all"

    def __init__(self, target, flips, temperature=1.0):
        self.target, self.flips, self.temperature = target, flips, temperature

    def __call__(self, rng, state):
        space = self.target.space
        theta, length, width = self.flips[int(rng.random() * len(self.flips))]
        values = state.values.copy()
        at = space.offsets
        values[at[theta]] = wrap(values[at[theta]] + 0.5 * space.unknowns[theta].period, space.unknowns[theta].period)
        values[at[length]], values[at[width]] = values[at[width]], values[at[length]]
        return decide(rng, state, evaluate(self.target, values), 0.0, self.temperature, self.name)


def flips_of(space) -> list[tuple[int, int, int]]:
    """Return (theta, length, width), as unknowns, of every box of which all three are unknown."""
    index = {unknown.address: i for i, unknown in enumerate(space.unknowns)}
    found = []
    for address, theta in index.items():
        name, _, rest = address.partition(".")
        if rest == "contact.theta" and space.unknowns[theta].period is not None:
            length, width = index.get(f"{name}.length"), index.get(f"{name}.width")
            if length is not None and width is not None:
                found.append((theta, length, width))
    return found


@kernels.register("flip")
class FlipType(KernelType):
    """Turn a box by a quarter and exchange its length and width."""

    per_block = False
    code = 5

    def applies(self, space, block):
        return bool(flips_of(space))

    def moves(self, space, block):
        return []

    def build(self, target, block, tuning, options):
        return Flip(target, flips_of(target.space), tuning.temperature)
