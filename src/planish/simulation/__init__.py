"""Synthetic captures with known truth: the reference sensor in front of textured surfaces.

`make_scene` gives a scene by name, `render_capture` its images, `true_points` its truth, `write_scene` the files.
"""
