"""Which solids explain an image best: hypotheses from its patches, greedy addition, moves between structures."""
