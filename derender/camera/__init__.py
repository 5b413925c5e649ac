"""Cameras, depth files and what sensors do to depth."""
