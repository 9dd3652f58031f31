"""Measurements of any other scanner, from a cloud, an image and its camera."""
