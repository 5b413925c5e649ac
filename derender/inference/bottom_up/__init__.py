"""From a depth image to hypotheses of solids."""
