"""What moves how: friction, restitution, mass ratios and velocities from tracked poses, and what happens next."""
