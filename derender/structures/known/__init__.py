"""Objects known beforehand: which of them each solid is, and where."""
