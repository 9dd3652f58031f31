"""Noise and range of grey values, estimated from the sequence itself."""
