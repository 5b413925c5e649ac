"""How good an answer is: matching, metrics, truth files."""
