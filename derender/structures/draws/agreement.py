"""Whether chains agree well enough for a quick look, or so little that going on is in vain."""

import numpy as np

from derender.sampling.diagnostics import bulk_ess, r_hat

AGREE, ENOUGH, FEW = 1.1, 25.0, 20  # R-hat and effective draws; draws of a chain from which on they mean something
FAR = 1.3  # R-hat of chains in modes of their own


def agree(values):
    """Whether chains (C, D, N) of enough draws to tell mix well enough to be trusted for a quick look."""
    if values.shape[1] < FEW:
        return True
    columns = np.moveaxis(values, -1, 0)
    return not any(r_hat(column) > AGREE or bulk_ess(column) < ENOUGH for column in columns)


def far_apart(values):
    """Whether chains (C, D, N) that have gone on are so far from agreeing that going on again will not help."""
    return any(r_hat(column) > FAR for column in np.moveaxis(values, -1, 0))
