"""Inference over the discrete part of scene graphs: which solids there are, and what each one stands on.

`infer.py` is the way through it: a bare image is searched, the structures near the best are drawn from (`draws/`) and
weighed (`graph_posterior.py`). `known/` does so with known objects; `jumps/` walks among all that a prior allows.
"""
