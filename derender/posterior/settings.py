"""The section `inference:` of a scene file: the mixture of kernels and its settings, as data."""

from typing import Any, NamedTuple

KEYS = ("kernels", "order", "thin", "particles", "population", "chains", "draws", "warmup")


class Settings(NamedTuple):
    """How chains are run.

    Attributes
    ----------
    kernels : entries such as {"drift": {"weight": 0.5}}, or None: the default mixture.
    cycle : kernels take turns, in the order of the file, instead of being drawn by weight.
    thin : steps for each draw.
    particles : draws from the prior that the start is resampled from.
    population : particles of the tempered SMC that looks for the mode; 1: none.
    chains, draws, warmup : counts.
    where : file and line, for messages.
    """

    kernels: list[dict[str, Any]] | None = None
    cycle: bool = False
    thin: int = 20
    particles: int = 200
    population: int = 32
    chains: int = 4
    draws: int = 1000
    warmup: int = 200
    where: str | None = None


def read_settings(section: Any) -> Settings:
    """Return the settings of a raw section, or the defaults where there is none.

    Raises
    ------
    DerenderError : an unknown key or a value of the wrong kind, with its line.
    """
    settings = Settings()
    if section is None:
        return settings
    section.allow(*KEYS)
    counts = {
        key: section[key].integer(lower=1, upper=10_000_000)
        for key in ("thin", "particles", "population", "chains", "draws")
        if key in section
    }
    if "warmup" in section:
        counts["warmup"] = section["warmup"].integer(lower=0, upper=10_000_000)
    settings = settings._replace(**counts)
    plain = section.plain()
    if "order" in section:
        if plain["order"] not in ("mixture", "cycle"):
            raise section["order"].fault(f"order is {plain['order']!r}", "choose mixture or cycle")
        settings = settings._replace(cycle=plain["order"] == "cycle")
    if "kernels" in section:
        section["kernels"].sequence()
        entries = [{entry: None} if isinstance(entry, str) else entry for entry in plain["kernels"]]
        for entry in entries:
            fits = isinstance(entry, dict) and all(v is None or isinstance(v, dict) for v in entry.values())
            if not fits:
                raise section["kernels"].fault("a kernel is not a name with options", "write - drift: {weight: 0.5}")
        settings = settings._replace(kernels=entries, where=section["kernels"].where)
    return settings
