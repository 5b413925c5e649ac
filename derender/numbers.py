"""Numbers as people write them in a scene file: strict decimal notation, with an optional unit ("20 deg", "5 mm").

A number is read only if every YAML 1.1 reader takes it for the same number; `1e-3` (text), `012` (ten) and `1:30`
(ninety) are refused with what would be right.
"""

import math
import re

from derender.errors import DerenderError

# How many of the base unit one named unit is, by base unit.
UNITS: dict[str, dict[str, float]] = {
    "m": {"m": 1.0, "cm": 0.01, "mm": 0.001},
    "rad": {"rad": 1.0, "deg": math.pi / 180.0},
    "kg": {"kg": 1.0, "g": 0.001},
    "s": {"s": 1.0, "ms": 0.001},
    "px": {"px": 1.0},
    "": {},
}

_DECIMAL = re.compile(r"[-+]?(?:0|[1-9][0-9]*|[0-9]+\.[0-9]*(?:[eE][-+][0-9]+)?|\.[0-9]+(?:[eE][-+][0-9]+)?)")
_LOOSE = re.compile(r"([-+]?)([0-9]*)(\.?)([0-9]*)(?:[eE]([-+]?)([0-9]+))?")
_WITH_UNIT = re.compile(r"(.*?)\s*([A-Za-z%°]+)")


def parse_number(text: str, unit: str = "") -> float:
    """Return the number that `text` says, in the base unit `unit` ("m", "rad", "kg", "s", "px" or "" for none).

    Raises
    ------
    DerenderError : if it is no finite number in strict notation, or its unit does not fit.
    """
    factor = 1.0
    digits = text.strip()
    if not _DECIMAL.fullmatch(digits) and not _LOOSE.fullmatch(digits):
        match = _WITH_UNIT.fullmatch(digits)
        if match and _LOOSE.fullmatch(match[1]) and re.search(r"[0-9]", match[1]):
            digits, named = match[1], match[2]
            known = UNITS.get(unit, {})
            if named not in known:
                good = " or ".join(known) if known else "a number without a unit"
                raise DerenderError(f"{_shown(text)} has a unit that does not fit here", remedy=f"write {good}")
            factor = known[named]
    if not _DECIMAL.fullmatch(digits):
        raise _fault(digits, text)
    value = float(digits) * factor
    if not math.isfinite(value):
        raise DerenderError(f"{_shown(text)} is too large", remedy="give a finite number")
    return value


def _fault(digits: str, text: str) -> DerenderError:
    """Say why `digits` is refused and what would be right."""
    match = _LOOSE.fullmatch(digits)
    if match and (match[2] or match[4]):
        sign, whole, _, fraction, exponent_sign, exponent = match.groups()
        if exponent is not None:
            right = f"{sign}{whole or '0'}.{fraction or '0'}e{exponent_sign or '+'}{exponent}"
            return DerenderError(f"{_shown(digits)} is text to a YAML reader, not a number", remedy=f"write {right}")
        if whole.startswith("0") and not fraction:
            right = f"{sign}{whole.lstrip('0') or '0'}"
            return DerenderError(f"{_shown(digits)} is octal to a YAML reader", remedy=f"write {right}")
    if digits.lower().lstrip("+-.") in ("inf", "nan", "infinity"):
        return DerenderError(f"{_shown(text)} is not a finite number", remedy="give a finite number")
    if re.fullmatch(r"[-+]?(?:0[xX][0-9a-fA-F_]+|0[bB][01_]+|[0-9]+(?::[0-9.]+)+|[0-9][0-9_]*\.?[0-9_]*)", digits):
        return DerenderError(f"{_shown(text)} is not in decimal notation", remedy="write plain digits, such as 1250.0")
    return DerenderError(f"{_shown(text)} is not a number", remedy="write one such as 0.05 or 20 deg")


def _shown(text: str) -> str:
    """Quote a piece of input, shortened, in printable characters."""
    return repr(text if len(text) <= 40 else text[:37] + "...")


def write_number(value: float) -> str:
    """Return the shortest decimal text that every YAML reader turns back into exactly this float (or int).

    >>> write_number(1e-05), write_number(0.1), write_number(3)
    ('1.0e-05', '0.1', '3')
    """
    if isinstance(value, int):
        return repr(value)
    text = repr(float(value))
    mantissa, e, exponent = text.partition("e")
    if e and "." not in mantissa:
        return f"{mantissa}.0e{exponent}"
    return text
