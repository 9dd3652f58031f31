"""Matches of keypoints: nearest descriptors, the correlation of what lies around them."""
