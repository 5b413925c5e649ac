"""What was there: targets, kernels, chains, structure, posteriors."""
