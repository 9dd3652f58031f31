"""The network of all pairs: groups, adjustment, blunders."""
