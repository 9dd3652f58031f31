"""The one error that means "what you gave me is not usable": says what, what was found and what was expected."""

from __future__ import annotations

from pathlib import Path


class InputError(ValueError):
    """Unusable input: an argument, a file or an option.

    Parameters
    ----------
    subject : str or Path
        The file or argument the error is about.
    found : str
        What was found.
    expected : str
        What would have been right.
    """

    def __init__(self, subject: str | Path, found: str, expected: str) -> None:
        self.subject, self.found, self.expected = str(subject), found, expected
        super().__init__(f"{subject}: {found}; expected {expected}")

    def __reduce__(self) -> tuple[type[InputError], tuple[str, str, str]]:
        """Return how to make this error again: it must pass from one process to another."""
        return type(self), (self.subject, self.found, self.expected)
