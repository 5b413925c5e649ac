"""derender types: what can stand in a scene file."""

import inspect
import json
from collections.abc import Callable, Iterable, Iterator
from itertools import groupby
from typing import Any

import click

from derender.cli import options
from derender.errors import DerenderError

HEAD = ("parameter", "unit", "from", "to", "default", "period", "slack")


@click.command()
@click.argument("name", required=False)
@options.as_json
def command(name: str | None, as_json: bool) -> None:
    """List the shapes, contacts, distributions, likelihoods, structures, constraints and kernels, or explain one.

    \b
    Examples:
        derender types
        derender types face-to-face
        derender types kernels
        derender types --json | python -m json.tool
    """
    entries = list(_entries())
    if name is not None:
        found = [entry for entry in entries if entry["name"] == name or entry["kind"] in (name, name.removesuffix("s"))]
        if not found:
            from derender.registry import suggest

            names = {entry["name"] for entry in entries}
            raise DerenderError(f"no type is called {name!r}", remedy=suggest(name, names))
        entries = found
    if as_json:
        click.echo(json.dumps(entries, indent=1))
    elif name is not None:
        click.echo("\n\n".join(_explanation(entry) for entry in entries))
    else:
        click.echo("\n".join(_listing(entries)))


def _entries() -> Iterator[Any]:
    """Yield each registered type: kind, name, what it is, its parameters."""
    from derender.posterior.kernels import kernels
    from derender.render.likelihoods import likelihoods
    from derender.scene.codec.scene_file import structures
    from derender.scene.contacts import contacts
    from derender.scene.distributions import distributions
    from derender.scene.priors.reading import contact_parameters
    from derender.scene.priors.terms import term_types
    from derender.scene.shapes import shapes

    def own(entry: Any) -> Iterator[dict]:
        return map(_parameter, entry.parameters)

    def none(entry: Any) -> Iterable[dict]:
        return ()

    kinds: dict[str, tuple[Any, Callable[[Any], Iterable[dict]]]] = {
        "shape": (shapes, own),
        "likelihood": (likelihoods, own),
        "contact": (contacts, lambda entry: map(_parameter, contact_parameters(entry.name).values())),
        "distribution": (distributions, lambda entry: ({"name": key} for key in entry.names)),
        "structure": (structures, none),
        "constraint": (term_types, none),
        "kernel": (kernels, lambda entry: ({"name": key, "default": value}
                                           for key, value in {"weight": 1.0, **entry.options}.items())),
    }  # fmt: skip
    for kind, (registry, parameters) in kinds.items():
        for name in registry:
            entry = registry[name]
            summary = inspect.getdoc(entry if inspect.isclass(entry) else type(entry)) or ""
            yield {"kind": kind, "name": name, "summary": summary, "parameters": list(parameters(entry))}


def _parameter(parameter: Any) -> dict[str, Any]:
    """Return a parameter as JSON holds it: an infinite bound is null."""
    data = {"name": parameter.name, "unit": parameter.unit}
    for key in ("lower", "upper", "default", "period"):
        value = getattr(parameter, key)
        data[key] = None if value is None or abs(value) == float("inf") else value
    return {**data, "slack": parameter.slack}


def _listing(entries: list[dict[str, Any]]) -> list[str]:
    lines: list[str] = []
    for kind, those in groupby(entries, key=lambda entry: entry["kind"]):
        lines += ["", f"{kind}s"] if lines else [f"{kind}s"]
        for entry in those:
            names = ", ".join(parameter["name"] for parameter in entry["parameters"])
            lines.append(f"  {entry['name']:<18} {names}".rstrip())
    return lines


def _explanation(entry: dict[str, Any]) -> str:
    """Return what is known of a type: what it is, and a line for each parameter."""
    from derender.report.tables import text_table

    parts = [f"{entry['kind']} {entry['name']}", entry["summary"]]
    if entry["parameters"]:
        columns = zip(HEAD, *map(_cells, entry["parameters"]), strict=True)
        head, *rows = zip(*(column for column in columns if set(column[1:]) != {"-"}), strict=True)
        parts.append(text_table(rows, head))
    return "\n\n".join(parts)


def _cells(parameter: dict[str, Any]) -> list[str]:
    """Return a parameter as HEAD names its columns; a dash where there is nothing to say."""
    known = {"lower": "-inf", "upper": "inf"} if "unit" in parameter else {}
    known |= {key: f"{value:g}" for key, value in parameter.items() if isinstance(value, float | int)}
    known |= {"unit": parameter.get("unit", ""), "slack": "slack" if parameter.get("slack") else ""}
    keys = ("unit", "lower", "upper", "default", "period", "slack")
    return [parameter["name"], *(known.get(key) or "-" for key in keys)]
