"""What identification says: draws for ArviZ, parameters for track.json, and lines for the terminal.

And what will happen (`predict`): films of the engine from drawn states and materials, with its errors at each impact.
"""

import json
import math
from collections.abc import Callable, Sequence
from functools import partial
from itertools import combinations, product
from pathlib import Path
from typing import Any

import numpy as np

from derender import __version__
from derender.atomic import atomic_path
from derender.dynamics.engine import (
    ENGINE_FRICTION,
    ENGINE_RESTITUTION,
    LASTING,
    LEVER,
    Engine,
    Material,
    Scales,
    velocity_errors,
)
from derender.dynamics.inference import Identified
from derender.dynamics.motion import Motion
from derender.dynamics.parameters import Parameters
from derender.dynamics.shooting import RESTS, Shooting
from derender.dynamics.states import CHANGE, moved, to_poses
from derender.physics.mujoco_model import Diverged

# A number is told by the motion where its standard deviation is at most this share of the prior's: of the few draws
# that count for something the deviation itself is uncertain by a fifth, and nothing that is untold may pass.
TOLD = 0.35
LEVEL = 0.9
# An error that is learnt to be so many of its prior's standard deviations above what is usual: the film is not one of
# things left alone at these times, under this gravity, seen by this camera.
UNEXPLAINED = 3.0
NOT_ALONE = "no materials explain this motion: is the frame rate, the gravity or the camera wrong, or does a hand help?"


class Answer:
    """Equally weighted draws of what was identified.

    draws : name -> (K,) or (K, 3) float64: friction, restitution, contact_time (s), mass_ratio.OF.TO; velocity.NAME
        (m / s) and angular_velocity.NAME (rad / s) in the first frame, in the frame of the poses; error.impact,
        error.steady, error.tracking and error.turning, the `Scales` of the engine. Numbers that may not be stated,
        such as restitution of what never rebounds, have the prior's draws.
        Of one of several motions in a film friction.NAMES, error.impact.NAMES and so on, as `of` says.
    told : names of the numbers that the motion tells.
    unexplained : whether no materials explain the motion, by how large the errors are then: nothing is told.
    """

    def __init__(
        self,
        found: Identified,
        rng: np.random.Generator,
        rate_spread: float = 0.0,
        level_spread: float = 0.0,
        of: str = "",
    ) -> None:
        """rate_spread : standard deviation of the logarithm of the frame rate, where it was guessed. level_spread : of
        gravity's inclination to the floor, radians. of : names of the bodies, where others of the film have an answer
        of their own."""
        self.parameters, self.of = found.parameters, of
        own = f".{of}" if of else ""
        self.labels = [name if name.startswith("mass_ratio.") else name + own for name in found.parameters.labels]
        coordinates, logarithms = found.draws.resampled(rng)
        usual, spread = self.parameters.prior.log_scales()
        rates = np.exp(rate_spread * rng.standard_normal(len(coordinates)))
        if found.told[0]:
            lasting = LASTING * max(float(np.exp(np.median(logarithms[:, 1])) - np.exp(usual[1])), 0.0)
            off = float(np.hypot(lasting, level_spread) / np.exp(coordinates[:, 0].mean()))
            coordinates[:, 0], rates = widened(
                coordinates[:, 0], np.hypot(ENGINE_FRICTION, off), rate_spread, self.parameters, rng
            )
        self.unexplained = bool((np.median(logarithms, axis=0) > usual + UNEXPLAINED * spread).any())
        if found.told[1]:
            coordinates[:, 1] += repeated_error(coordinates[:, 1], logarithms[:, 0]) * rng.standard_normal(
                len(coordinates)
            )
        stated = found.stated & (not self.unexplained)
        if rate_spread and found.struck:  # what flies or topples does so at one rate alone
            stated[1:] = False
        unstated = found.told & ~stated
        coordinates[:, unstated] = [self.parameters.sample_prior(rng)[unstated] for _ in coordinates]
        values = found.parameters.values(coordinates)
        values[:, 1] = np.clip(values[:, 1], 0.0, 1.0)
        self.draws: dict[str, np.ndarray] = dict(zip(self.labels, values.T, strict=True))
        narrow = coordinates.std(axis=0) <= TOLD * found.parameters.spread()
        self.told = [name for name, yes in zip(self.labels, narrow & stated, strict=True) if yes]
        mode = found.modes[0]
        lower = np.linalg.cholesky(mode.first + 1e-12 * np.eye(len(mode.first)))
        changes = (rng.standard_normal((len(values), len(lower))) @ lower.T).reshape(len(values), -1, CHANGE)
        states = moved(np.broadcast_to(mode.path.states[0], (len(values), *mode.path.states[0].shape)), changes)
        turns = to_poses(states)[..., :3, :3]
        for k, name in enumerate(found.parameters.names):
            self.draws[f"velocity.{name}"] = rates[:, None] * states[:, k, 7:10]
            turning = np.einsum("kij,kj->ki", turns[:, k], states[:, k, 10:])
            self.draws[f"angular_velocity.{name}"] = rates[:, None] * turning
        for number, name in enumerate(("impact", "steady", "tracking", "turning")):
            self.draws[f"error.{name}{own}"] = np.exp(logarithms[:, number])

    def interval(self, name: str) -> tuple[float, float, float]:
        """Return the mean and the ends of the 90 % interval."""
        low, high = np.quantile(self.draws[name], [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
        return float(np.mean(self.draws[name])), float(low), float(high)

    def json(self) -> dict[str, Any]:
        """Return `parameters` of track.json: what the motion tells. Of several mass ratios, the best told one."""
        result: dict[str, Any] = {}
        ratios = []
        for name in self.told:
            mean, low, high = self.interval(name)
            said = {"mean": mean, "interval": [low, high]}
            if name.startswith("contact_time"):  # of the model of a bounce, not of what a film is asked for
                continue
            if name.startswith("mass_ratio."):
                _, of, to = name.split(".")
                ratios.append((high / low, {"of": of, "to": to, **said}))
            else:
                result[name] = said
        if ratios:
            result["mass_ratio"] = min(ratios, key=lambda pair: pair[0])[1]
        return result

    def lines(self) -> list[str]:
        """Return a line for each number: mean and 90 % interval, or that the motion does not tell it."""
        lines = self.notes()
        for name in self.labels:
            mean, low, high = self.interval(name)
            kind, *words = name.split(".")
            title = " ".join([f"mass of {words[0]} /" if kind == "mass_ratio" else kind, *words[-1:]])
            unit = " s" if kind == "contact_time" else ""
            told = f"{mean:.3f} ({low:.3f}-{high:.3f}){unit}" if name in self.told else "the motion does not tell"
            lines.append(f"{title:<14} {told}")
        for name in self.parameters.names:
            velocity = self.draws[f"velocity.{name}"]
            mean, error = velocity.mean(axis=0), velocity.std(axis=0)
            shown = ", ".join(f"{m:.3f} ± {e:.3f}" for m, e in zip(mean, error, strict=True))
            lines.append(f"{f'speed of {name}':<14} {shown} m/s at first")
        return lines

    def notes(self) -> list[str]:
        """Return what is to be said where no materials explain the motion."""
        return [f"{self.of}: {NOT_ALONE}" if self.of else NOT_ALONE] if self.unexplained else []


def parameters_of(answers: Sequence[Answer]) -> dict[str, Any]:
    """Return `parameters` of track.json. Of several motions, friction and restitution are those told best, with what
    they are `of`, and all stand under their own names too."""
    result: dict[str, Any] = {}
    for answer in reversed(answers):
        result |= answer.json()
    for kind in ("friction", "restitution"):
        told = [{"of": a.of, **result[f"{kind}.{a.of}"]} for a in answers if f"{kind}.{a.of}" in result]
        if told:
            result[kind] = min(told, key=lambda said: np.ptp(said["interval"]) / said["mean"])
    return result


def write_draws(path: str | Path, answers: Sequence[Answer], **made: Any) -> None:
    """Write the draws, each (1, K) or (1, K, 3): chain, draw, axis; `header` is JSON with seed, version and more.

    `arviz.from_dict({name: array})` takes them as they are, `header` left out.
    """
    header = json.dumps({"version": __version__, "told": [name for answer in answers for name in answer.told], **made})
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        arrays = {name: values[None] for answer in answers for name, values in answer.draws.items()}
        np.savez_compressed(file, allow_pickle=False, header=np.array(header), **arrays)


def widened(
    draws: np.ndarray, off: float, rate_spread: float, parameters: Parameters, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return draws (K,) of friction's logarithm moved to where they are if what was seen tells it with a further
    standard error `off`, and at a rate that is unsure; and of that rate, times the one taken.

    Through the same poses a thing slides on a level floor with friction by the square of the rate. All is taken for
    normal, but where the prior ends; it remains where nothing is told any more.
    """
    middle, spread = parameters.middle()[0], parameters.spread()[0]
    mean, variance = draws.mean(), draws.var()
    told = max(1 / variance - 1 / spread**2, 0.0)  # the likelihood's precision, and the number that it says times that
    says = mean / variance - middle / spread**2
    share = 1 / (1 + told * (off**2 + 4 * rate_spread**2))
    precision = share * told + 1 / spread**2
    wide = (share * says + middle / spread**2) / precision + (draws - mean) / np.sqrt(variance * precision)
    within = np.isfinite([parameters.prior.friction.log_density(math.exp(each)) for each in wide])
    if within.any():
        wide[~within] = rng.choice(wide[within], np.sum(~within))
    left = rate_spread * np.sqrt(1 - 4 * rate_spread**2 * share * told)
    rates = 2 * rate_spread**2 * share * (told * wide - says) + left * rng.standard_normal(len(wide))
    return wide, np.exp(rates)


def repeated_error(restitution: np.ndarray, logarithms: np.ndarray) -> float:
    """Return the standard error that draws (K,) of restitution lack; logarithms : (K,), of the error of impacts.

    That is learnt as if each impact had another one. Two balls that rebound differently, or a film that runs backwards,
    err by the same each time: many impacts tell restitution no better than one.
    """
    one = (1 + float(restitution.mean())) * float(np.exp(np.median(logarithms)))
    return float(np.hypot(ENGINE_RESTITUTION, np.sqrt(max(one**2 - float(restitution.var()), 0.0))))


# Bodies have entered each other by more than tracking is off, metres: the engine would throw them apart.
ENTERED = 3e-4
# A body rests where it is slower than RESTS (turning: by its size) in so many intervals on end.
CALM = 3

Normal = Callable[[int | tuple[int, ...]], np.ndarray]


def come_to_rest(
    engine: Engine,
    sizes: np.ndarray,
    states: np.ndarray,
    material: Material,
    most: int,
    scales: Scales | None = None,
    normal: Normal | None = None,
) -> np.ndarray:
    """Return the states (N, 13) when all bodies rest, or after `most` intervals, from `states` (N, 13).

    With `scales` and `normal`, velocities are off after each interval by a normal error of what contacts gave.

    sizes : (N,) mean side of each body, metres. normal : draws standard normal numbers of a shape.
    """
    engine.tell(material)
    now, calm = np.asarray(states, float), 0
    for _ in range(most):
        after = engine.advance(now)
        speed = np.hypot(np.linalg.norm(after[:, 7:10], axis=1), np.linalg.norm(after[:, 10:], axis=1) * sizes)
        calm = calm + 1 if speed.max() < RESTS else 0
        if scales is not None and normal is not None:
            error = velocity_errors(engine.impulses(now, after, material.friction), scales)
            error = np.where(speed > RESTS, error, 0.0)
            after[:, 7:10] += error[:, None] * normal((len(after), 3))
            after[:, 10:] += (LEVER * error / sizes)[:, None] * normal((len(after), 3))
        now = after
        if calm == CALM:
            break
    return now


def last_apart(shooting: Shooting, states: np.ndarray) -> int:
    """Return the last frame of a path's states (T, N, 13) in which no two bodies have entered each other.

    Bodies that lie on a floor pass through each other there: where they strike each other after the last cut, what
    follows begins before it.
    """
    for frame in range(shooting.frames - 1, 0, -1):
        bodies = [b._replace(pose=p) for b, p in zip(shooting.bodies, to_poses(states[frame]), strict=True)]
        if not shooting.apart or all(first.gap(second) > -ENTERED for first, second in combinations(bodies, 2)):
            return frame
    return 0


def predict(found: Identified, motion: Motion, rng: np.random.Generator, count: int, most: int) -> np.ndarray:
    """Return draws (K, N, 13) of the states in which bodies come to rest, K at most `count`.

    A draw's unknown states are normal about the mode given its material; the engine then goes on from the last frame
    of `motion`, from which `found` was identified. Of each two draws the second has the first one's errors with the
    other sign (antithetic variates), so that a few tell well where the middle is. Draws that diverge are left out.

    most : intervals after the last frame.
    """
    engine, seen = (Engine(motion.matter, motion.names, motion.step) for _ in range(2))
    shooting, mode = Shooting(motion, found.parameters, seen), found.modes[0]
    size, whole = shooting.size, mode.covariance
    gain = whole[:size, size:] @ np.linalg.inv(whole[size:, size:])
    given = whole[:size, :size] - gain @ whole[size:, :size]
    lower = np.linalg.cholesky(given + 1e-12 * np.eye(size))
    draws = []
    pairs = zip(*found.draws.resampled(rng, -(-count // 2)), rng.integers(2**63, size=-(-count // 2)), strict=True)
    for (coordinates, logarithms, seed), sign in product(pairs, (1.0, -1.0)):
        normal = partial(_signed_normal, np.random.default_rng(seed), sign)
        off = np.where(found.told, coordinates - mode.path.coordinates, 0.0)
        change = np.concatenate([gain @ off + lower @ normal(size), off])
        try:
            path = shooting.stepped(mode.path, change)
            material = found.parameters.material(found.parameters.inside(coordinates))
            scales = Scales(*np.exp(logarithms))
            frame = last_apart(shooting, path.states)
            ahead = most + shooting.frames - 1 - frame
            draws.append(come_to_rest(engine, shooting.sizes, path.states[frame], material, ahead, scales, normal))
        except Diverged:
            continue
    return np.array(draws[:count])


def _signed_normal(rng: np.random.Generator, sign: float, shape: int | tuple[int, ...]) -> np.ndarray:
    return sign * rng.standard_normal(shape)
