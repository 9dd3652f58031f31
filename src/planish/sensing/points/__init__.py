"""From projector positions to points: correspondence, triangulation, the third ray, rejection."""
