"""Inference over the discrete part of scene graphs: which solids there are, and what each one stands on; see
`infer.py`."""
