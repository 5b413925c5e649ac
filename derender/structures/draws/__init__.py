"""Draws of all numbers of one structure, under the noise and blur that the image itself shows."""
