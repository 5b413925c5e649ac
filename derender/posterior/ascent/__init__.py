"""Maximum a posteriori estimation: second-order steps, the paper's fixed-step ascent, and their parts."""
