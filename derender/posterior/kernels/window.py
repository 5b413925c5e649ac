"""Window: an enumerative step. Weigh a row of equally spaced places through the present one and choose among them."""

import math

import numpy as np

from derender.posterior.kernels.base import Info, KernelType, evaluate, kernels

FINEST = 1e-4  # of the prior's spread: the shortest spacing


class Window:
    """Gibbs draw among `count` places on a line through the state, coarse to fine.

    A spacing is drawn log-uniformly between FINEST and `reach` times the prior's spread, a direction at random (each
    coordinate takes part with probability 1/2), and the place j of the present state in the row uniformly. The row is
    values + (k - j) * spacing * direction, k = 0 .. count - 1; the next state is its k-th place with probability
    proportional to the posterior there. Spacing and direction do not depend on the state. From the chosen place k the
    same row arises with j' = k, which has the same probability 1 / count, so with w the posterior,

        w(j) (1 / count) w(k) / sum(w)  =  w(k) (1 / count) w(j) / sum(w)

    is detailed balance: there is nothing left to accept, log ratio = 0. (On circles and lines only: directions in the
    group of rotations do not commute, there the row moves along one axis through the state, which it leaves in place.)
    """

    def __init__(self, target, block, directions, count, reach, temperature=1.0, kind="window"):
        self.target, self.block, self.temperature = target, block, temperature
        self.directions, self.count, self.reach = directions, count, reach
        self.name = f"{kind} {block.name}"

    def place(self, state, tangent):
        """Return the state after a step by `tangent`, and the log of what its density is multiplied by."""
        return evaluate(self.target, self.target.space.move(state.values, self.block, tangent)), 0.0

    def __call__(self, rng, state):
        size = len(self.directions)
        spacing = self.reach * math.exp(rng.random() * math.log(FINEST / self.reach))
        tangent = np.empty(size)
        used = 0
        for i in range(size):
            tangent[i] = rng.standard_normal() * self.directions[i]
        keep = np.empty(size, bool)
        for i in range(size):
            keep[i] = rng.random() < 0.5
            used += keep[i]
        for i in range(size):
            if used and not keep[i]:
                tangent[i] = 0.0
        present = int(rng.random() * self.count)

        places, logs = [], []
        for k in range(self.count):
            step = (k - present) * spacing
            place, log_factor = (state, 0.0) if k == present else self.place(state, step * tangent)
            places.append(place)
            log = -math.inf
            if place.log_prior > -math.inf:
                log = place.log_prior + self.temperature * place.log_likelihood + log_factor
            logs.append(log)
        highest = max(logs)
        total = 0.0
        for log in logs:
            total += math.exp(log - highest)
        threshold = rng.random() * total
        running = 0.0
        chosen = present
        for k in range(self.count):
            running += math.exp(logs[k] - highest)
            if threshold < running:
                chosen = k
                break
        return places[chosen], Info(chosen != present, 0.0, self.name)


@kernels.register("window")
class WindowType(KernelType):
    """Choose among a row of places by their posterior, spaced from the prior's width to a ten-thousandth of it."""

    options = {"count": 8, "reach": 0.5}
    code = 3

    def build(self, target, block, tuning, options):
        from derender.posterior.kernels.drift import directions_of

        scales = target.space.scales[directions_of(target.space, block)]
        return Window(target, block, scales, int(options["count"]), options["reach"], tuning.temperature)
