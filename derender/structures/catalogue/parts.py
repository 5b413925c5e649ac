"""What chains over a catalogue came by, as the parts of a posterior and the figures that say how far they agree."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from derender.sampling import diagnostics
from derender.sampling.checkpoint import Record
from derender.structures.catalogue.entry import Entry
from derender.structures.draws.metropolis import Draws
from derender.structures.draws.refined import refined_at, structure_posterior


def parts_of(entries: Sequence[Entry], sensor, records: Sequence[Record]):
    """Return (parts, meta): one part for each entry that was visited, its weight the share of the draws there.

    Where the chains were there for unlike numbers of draws, the part has the draws of the shortest of them, or all
    draws as one chain where that leaves out more than half.
    """
    total = sum(record.drawn for record in records)
    parts = []
    for number, entry in enumerate(entries):
        chains = [draws_at(record, number, len(entry.mean)) for record in records]
        chains = [chain for chain in chains if len(chain.values)]
        if not chains:
            continue
        count = sum(len(chain.values) for chain in chains)
        shortest = min(len(chain.values) for chain in chains)
        if 2 * shortest * len(chains) >= count:
            chains = [Draws(each.values[:shortest], each.densities[:shortest], each.accepted) for each in chains]
        else:
            values, densities = (np.concatenate([each[k] for each in chains]) for k in (0, 1))
            chains = [Draws(values, densities, chains[0].accepted)]
        tops = [(chain, int(np.argmax(chain.densities.sum(axis=1)))) for chain in chains]
        chain, i = max(tops, key=lambda pair: pair[0].densities[pair[1]].sum())
        refined = refined_at(entry.state, entry.chart, chain.values[i], sensor, *chain.densities[i])
        parts.append(structure_posterior(refined, list(entry.names), count / total, chains))
    return sorted(parts, key=lambda part: -part.weight), {"structure_chains": agreement(records)}


def draws_at(record: Record, number: int, size: int) -> Draws:
    """Return a chain's draws at one entry, in their order."""
    there = record.state["visited"] == number
    densities = np.stack([record.log_prior[there], record.log_likelihood[there]], axis=1)
    tried = max(float(record.state["tried"].sum()), 1.0)
    return Draws(record.values[there][:, :size], densities, float(record.state["taken"].sum()) / tried)


def agreement(records: Sequence[Record]) -> dict[str, Any]:
    """Return how far chains agree about the structure: shares of the likeliest by chain, R-hat and ESS of its being
    visited (None where it always is), leaps tried and taken; of populations their log evidences."""
    visited = [record.state["visited"] for record in records]
    likeliest = int(np.bincount(np.concatenate(visited)).argmax())
    shortest = min(len(chain) for chain in visited)
    there = np.array([(chain[:shortest] == likeliest).astype(float) for chain in visited])
    found: dict[str, Any] = {
        "shares": [float(np.mean(chain == likeliest)) for chain in visited],
        "r_hat": None if there.all() else number_or_none(diagnostics.r_hat(there)),
        "ess": None if there.all() else number_or_none(diagnostics.mean_ess(there)),
        "leaps_tried": int(sum(record.state["tried"].sum() for record in records)),
        "leaps_taken": int(sum(record.state["taken"].sum() for record in records)),
    }
    if "log_evidence" in records[0].state:
        found["log_evidence"] = [float(record.state["log_evidence"]) for record in records]
        found["effective"] = [float(record.state["effective"].min()) for record in records]
    return found


def number_or_none(value: float) -> float | None:
    """Return a number as JSON can hold it."""
    return float(value) if np.isfinite(value) else None
