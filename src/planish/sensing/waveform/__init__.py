"""Fringes that are no cosine: found from the phases alone, and corrected."""
