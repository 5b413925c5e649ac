"""What a camera sees: cameras, depth files, renderers, likelihoods. Knows no sampler."""
