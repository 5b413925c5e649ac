"""What happens next: MuJoCo simulation and stability."""
