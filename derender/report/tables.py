"""Tables: each free number of a posterior with its mean, spread and the health of its chains."""

import functools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from derender.render.likelihoods import likelihoods
from derender.sampling.diagnostics import summary, unwrap
from derender.scene.contacts import contacts
from derender.scene.priors.reading import contact_parameters
from derender.scene.shapes import shapes

READ_AS = {"rad": ("°", 180 / np.pi), "m": ("mm", 1000.0)}  # what people read, and how many of it make one of ours
ROOT_ANGLES = ("elevation", "azimuth", "roll")

COLUMNS = ("address", "mean", "sd", "5 %", "95 %", "R-hat", "ESS", "tail ESS")


def unit_of(address: str) -> tuple[str, float]:
    """Return the unit in which people read a number, and how many of it make one of ours (radian, metre)."""
    name, _, rest = address.partition(".")
    last = rest.rpartition(".")[2]
    if name == "root":
        ours = "rad" if last in ROOT_ANGLES else "" if last.startswith("q") else "m"
    else:
        ours = _units("likelihood" if name == "likelihood" else "contact" if rest != last else "shape").get(last, "")
    return READ_AS.get(ours, (ours, 1.0))


@functools.cache
def _units(room: str) -> dict[str, str]:
    """Return the units of all numbers of the registered likelihoods, contacts or shapes by name."""
    if room == "contact":
        found = [parameter for name in contacts for parameter in contact_parameters(name).values()]
    else:
        owners: Any = likelihoods if room == "likelihood" else shapes
        found = [parameter for name in owners for parameter in owners[name].parameters]
    return {parameter.name: parameter.unit for parameter in found}


def parameter_rows(
    addresses: Sequence[str], values: np.ndarray, periods: Mapping[str, float | None] | None = None
) -> list[dict[str, Any]]:
    """Return a row for each free number of one structure: `address`, `unit`, `scale`, the entries of
    `diagnostics.summary` in our own units, and `draws` (chains, draws).

    values : (chains, draws, P) float64, in metres and radians.
    periods : of those that are angles; they are unwrapped about their circular mean.
    """
    rows = []
    for index, address in enumerate(addresses):
        period = (periods or {}).get(address)
        draws = unwrap(np.asarray(values[:, :, index], float), period)
        unit, scale = unit_of(address)
        rows.append({"address": address, "unit": unit, "scale": scale, **summary(draws), "draws": draws})
    return rows


def columns(rows: Sequence[Mapping[str, Any]]) -> tuple[str, ...]:
    """Return the heads of the columns of these rows; of one draw, as `--method map` has it, the value alone."""
    return COLUMNS if rows[0]["draws"].size > 1 else ("address", "value")


def cells(row: Mapping[str, Any]) -> list[str]:
    """Return the texts of a row's columns, in the unit that people read."""
    scale, unit = row["scale"], row["unit"]
    digits = 2 if unit else 4
    name = f"{row['address']} ({unit})" if unit else str(row["address"])
    numbers = [f"{row[key] * scale:.{digits}f}" for key in ("mean", "sd", "q05", "q95")]
    if row["draws"].size == 1:
        return [name, numbers[0]]
    health = (("r_hat", ".3f"), ("ess_bulk", ".0f"), ("ess_tail", ".0f"))
    return [name, *numbers, *(number_or_dash(row[key], form) for key, form in health)]


def number_or_dash(value: float | None, form: str) -> str:
    """Return a number as text, or a dash where there is none."""
    return "–" if value is None or not np.isfinite(value) else format(value, form)


def text_table(rows: Sequence[Sequence[str]], header: Sequence[str]) -> str:
    """Return lines of columns, the first to the left and the others to the right."""
    table = [header, *rows]
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    lines = []
    for first, *others in table:
        cells = (cell.rjust(wide) for cell, wide in zip(others, widths[1:], strict=True))
        lines.append("  ".join([first.ljust(widths[0]), *cells]).rstrip())
    return "\n".join(lines)


def parameter_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the rows of a posterior as text for a terminal."""
    return text_table([cells(row) for row in rows], columns(rows))
