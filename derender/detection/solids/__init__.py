"""Solids over a floor: how well they explain an image, whether they touch, what each one stands on."""
