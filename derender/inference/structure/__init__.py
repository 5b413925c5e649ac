"""Inference over the discrete part of scene graphs."""
