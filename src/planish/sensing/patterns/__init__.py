"""What a projector shows: the entries of a sequence, their brightness, whole sequences, and their files."""
