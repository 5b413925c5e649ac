"""A number or a distribution over it: the leaves of every prior."""

import math
from collections.abc import Sequence
from typing import Any

from derender.errors import DerenderError
from derender.registry import Parameter
from derender.scene.codec.yaml_tree import Node
from derender.scene.distributions import Distribution

Value = float | Distribution

SAME = 1e-9  # a fixed number matches within this, so that a pose may pass through a matrix

SMALLEST, LARGEST = 1e-6, 1e6  # metres: below and above, squares and volumes lose all digits to rounding
NEVER = 1e-9  # a distribution may leave a range with this probability: a side of 10 cm plus or minus 5 mm

ROTATION = ("qw", "qx", "qy", "qz")  # four values of a contact that are one rotation
QUATERNION = "quat_wxyz"  # the key and address of the four together


def log_density(value: Value, x: float) -> float:
    """Return the log density of x: of a fixed number 0 where x is it, else -inf."""
    if type(value) is float:
        return 0.0 if abs(x - value) <= SAME else -math.inf
    return value.log_density(x)  # type: ignore[union-attr]


def draw(value: Value, rng: Any) -> float:
    """Return the number, or a draw where it is a distribution."""
    return value if type(value) is float else value.sample(rng)  # type: ignore[union-attr]


def check_range(value: Value, parameter: Parameter, place: Node | None = None, strict: bool = False) -> None:
    """Refuse a number, or a distribution that reaches, outside the range of a parameter (a periodic one has none).

    A `strict` range does not hold its ends.

    Raises
    ------
    DerenderError : at `place`.
    """
    if parameter.period is not None or parameter.name in ROTATION:
        return
    allowed = f"{parameter.name} lies in {_interval(parameter, strict)}"
    if isinstance(value, float):
        inside = parameter.lower < value < parameter.upper if strict else parameter.lower <= value <= parameter.upper
        if not inside:
            raise fault(place, f"{parameter.name} is {value:g}, out of range", allowed)
        if parameter.unit == "m" and not (value == 0.0 or SMALLEST <= abs(value) <= LARGEST):
            remedy = f"lengths lie between {SMALLEST:g} and {LARGEST:g} m"
            raise fault(place, f"{parameter.name} is {value:g} m, beyond what can be computed with", remedy)
        return
    low, high = value.support
    slip = 1e-12 * max(1.0, abs(parameter.upper) if math.isfinite(parameter.upper) else 1.0)
    below = value.cdf(parameter.lower) if low < parameter.lower - slip else 0.0
    above = 1.0 - value.cdf(parameter.upper) if high > parameter.upper + slip else 0.0
    if below + above > NEVER:
        what = f"with probability {below + above:.2g} this distribution leaves the range"
        raise fault(place, what, f"{allowed}; cut it, as {{truncated-normal: [mean, sd, lower, upper]}} does")


def _interval(parameter: Parameter, strict: bool) -> str:
    """Return a parameter's range in words: "(0, inf)" where its ends do not belong to it."""
    left = "(" if strict or math.isinf(parameter.lower) else "["
    right = ")" if strict or math.isinf(parameter.upper) else "]"
    return f"{left}{parameter.lower:g}, {parameter.upper:g}{right}"


def default_value(parameter: Parameter) -> Value | None:
    """Return the uniform distribution over a parameter's range or period; None where that is unbounded."""
    from derender.scene.distributions import distributions

    if parameter.period is not None:
        lower = parameter.lower if math.isfinite(parameter.lower) else 0.0
        return distributions["uniform"](lower, lower + parameter.period)  # type: ignore[return-value]
    if math.isfinite(parameter.lower) and math.isfinite(parameter.upper):
        return distributions["uniform"](parameter.lower, parameter.upper)  # type: ignore[return-value]
    return None


def fault(place: Node | None, what: str, remedy: str | None = None) -> DerenderError:
    """Return a DerenderError at a place in a file, where there is one."""
    return place.fault(what, remedy) if place is not None else DerenderError(what, remedy=remedy)


def unit_quaternion(parts: Sequence[float], place: Node | None = None) -> tuple[float, ...]:
    """Return four numbers normalised; refuse them where they are not a rounded unit quaternion."""
    norm = math.sqrt(math.fsum(part * part for part in parts))
    if not abs(norm - 1.0) < 0.01:
        raise fault(place, f"the quaternion has length {norm:.3g}", "give a unit quaternion [w, x, y, z]")
    return tuple(parts) if abs(norm - 1.0) < 1e-12 else tuple(part / norm for part in parts)
