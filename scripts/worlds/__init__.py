"""Made scenes with known truth, on which scripts measure and tests check; no part of what is installed."""
