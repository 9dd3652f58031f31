"""From the files of a board run to what cameras and projector saw of the board."""
