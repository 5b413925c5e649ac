"""The compiled renderer and likelihood: no OpenGL, no Python in the inner loop."""
