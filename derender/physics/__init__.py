"""What happens next: MuJoCo models, simulation, stability."""
