"""Jumps between the structures that one image suggests, their numbers proposed from what each was found to be like."""
