"""Fixed-structure chains without Python in the inner loop."""
