"""What a camera sees of a scene: depth, its derivatives, and its likelihood."""
