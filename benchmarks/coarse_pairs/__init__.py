"""Simulated parts and pairs of the coarse registration, the peers beside it, its tables."""
