"""The density of one structure whose numbers are unknown, the kernels that walk on it, and ascent to its mode."""
