"""Point clouds in the formats of other programs."""
