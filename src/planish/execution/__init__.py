"""Where work is done and kept: executors that run functions over items, and the store of what stages have computed."""
