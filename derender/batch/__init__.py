"""Many frames: found, inferred one by one in several processes or on a cluster, gathered in tables and a page."""
