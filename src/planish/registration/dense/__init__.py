"""The dense path: registration by correlation of the whole texture, where it is too weak for keypoints."""
