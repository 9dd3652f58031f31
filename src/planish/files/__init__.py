"""Clouds of other programs: reading and writing."""
