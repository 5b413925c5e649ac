"""Prior distributions over scene graphs (A.1): fixed trees, Algorithm 1, a grammar; constraints on top of any."""
