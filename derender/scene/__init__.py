"""What a scene is: shapes, contacts, scene graphs, distributions, priors. Knows no pixel."""
