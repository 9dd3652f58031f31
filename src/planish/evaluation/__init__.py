"""How well registered measurements agree: without truth on their overlap, with truth by transform."""
