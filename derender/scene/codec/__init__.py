"""Scene files: YAML read strictly, with lines and addresses, and written back."""
