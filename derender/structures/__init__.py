"""Inference over the discrete part of scene graphs: which solids there are, and what each one stands on.

`infer.py` is the way through it: a bare image is searched (`search/`, on `solids/`), the structures near the best are
drawn from (`draws/`) and weighed (`graph_posterior.py`, `alternatives.py`). `known/` does that with objects known
beforehand; `jumps/` walks among all that a prior allows.
"""
