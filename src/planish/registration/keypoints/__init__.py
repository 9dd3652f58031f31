"""Keypoints of the texture images: what they are, where they are, what they look like."""
