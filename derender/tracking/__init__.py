"""Solids followed through a film of depth images: poses, sizes and contacts of each frame, with their uncertainty."""
