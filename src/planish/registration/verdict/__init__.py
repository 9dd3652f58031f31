"""The verdict on a pair: what chance explains, what stands still, what contradicts; a status with its reason."""
