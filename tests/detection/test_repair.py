"""How long the search looks for something better."""

from types import SimpleNamespace

import numpy as np

from derender.detection.search import searches
from derender.detection.search.greedy import Settings


def test_a_quick_search_ends_where_nothing_is_left_and_a_whole_one_goes_on(monkeypatch):
    asked = []
    monkeypatch.setattr(searches, "find_places", lambda *_: SimpleNamespace(none_left=lambda settings: explained))
    monkeypatch.setattr(searches, "total_energy", lambda *_: 0.0)
    monkeypatch.setattr(searches, "propose", lambda *_: asked.append(1))

    def rounds(tries):
        asked.clear()
        searches.repair(np.random.default_rng(0), None, [], [], Settings(tries=tries, quiet=10), [])
        return len(asked)

    explained = True
    assert rounds(tries=1) == 0 and rounds(tries=2) == 10
    explained = False
    assert rounds(tries=1) == 10 and rounds(tries=2) == 10 * searches.IN_VAIN
