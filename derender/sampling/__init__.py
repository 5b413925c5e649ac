"""Chains, checkpoints, workers and diagnostics: sampling that knows no scene."""
