"""Samplers that spawned processes can import: a random walk on a normal, and ways for it to go wrong."""

import time

import numpy as np

from derender.sampling.chains import Segment


class Walk:
    """Metropolis on a two-dimensional normal; adapts its step in warm-up; optionally slow or doomed."""

    segment = 10

    def __init__(self, seconds=0.0, doomed=()):
        self.seconds, self.doomed = seconds, doomed

    def start(self, rng):
        return {"values": rng.standard_normal(2) * 10, "step": np.array(5.0), "accepted": np.array(0)}

    def _step(self, rng, state):
        values, step = state["values"], state["step"]
        proposed = values + step * rng.standard_normal(2)
        if np.log(rng.random()) < (values @ values - proposed @ proposed) / 2:
            return {"values": proposed, "step": step, "accepted": state["accepted"] + 1}
        return state

    def warm_up(self, rng, state, done, rounds, total):
        for _ in range(rounds):
            accepted = state["accepted"]
            state = self._step(rng, state)
            state = state | {"step": state["step"] * (1.1 if state["accepted"] > accepted else 0.95)}
        return state

    def advance(self, rng, state, draws):
        values = np.empty((draws, 2))
        for i in range(draws):
            state = self._step(rng, state)
            values[i] = state["values"]
        if self.seconds:
            time.sleep(self.seconds)
        if self.doomed and rng.bit_generator.seed_seq.spawn_key[0] in self.doomed:
            raise ArithmeticError("doomed")
        return state, Segment(values, np.column_stack([np.zeros(draws), -0.5 * np.sum(values**2, axis=1)]))
