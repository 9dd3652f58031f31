"""Pairs with their truth for the refinement: errors, bound, covariance, failures, peers, tables."""
