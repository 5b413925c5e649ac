"""Numba functions, compiled once and kept; threads to run them in."""
