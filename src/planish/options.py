"""Base of all options: validated, frozen, unknown keys refused. Each stage's options stand in its module."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Self

from pydantic import BaseModel, ConfigDict, ValidationError

from planish.errors import InputError


class Strict(BaseModel):
    """Base of everything that is read from outside: unknown keys are errors, values are frozen."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @classmethod
    def parse(cls, values: Any, subject: str) -> Self:
        """Validate `values`; an error names `subject`, the key, what was found and what was expected."""
        try:
            return cls.model_validate(values)
        except ValidationError as error:
            raise _input_error(error, subject) from None


class Options(Strict):
    """Base of a stage's options. Names carry their unit (`_mm`, `_px`, `_rad`, `_deg`); none = a pure number."""

    def scaled(self, factor: float) -> Self:
        """Return these options with all lengths (`_mm`) that were left at their defaults multiplied by `factor`.

        Defaults are made for one ground sample distance; a sensor that sees finer or coarser needs them in proportion.
        """
        values: dict[str, Any] = {}
        for name in type(self).model_fields:
            value = getattr(self, name)
            if isinstance(value, Options):
                values[name] = value.scaled(factor)
            elif name.endswith("_mm") and name not in self.model_fields_set:
                values[name] = tuple(factor * v for v in value) if isinstance(value, tuple) else factor * value
        return self.model_copy(update=values)


def thread_count(threads: int | None = None) -> int:
    """Return the number of threads to use: the argument, else PLANISH_THREADS, else the processors of this process.

    Raises
    ------
    InputError
        Where the number is not a whole number >= 1.
    """
    if threads is None:
        text = os.environ.get("PLANISH_THREADS")
        if text is None:
            return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        if not text.isdecimal():
            raise InputError("PLANISH_THREADS", f"found {text!r}", "a whole number >= 1")
        threads = int(text)
    if threads < 1:
        raise InputError("threads", f"found {threads}", "a whole number >= 1")
    return threads


def side_by_side(jobs: Sequence[Callable[[], Any]], threads: int) -> list[Any]:
    """Return what each job returns, in order; with one thread they run one after the other in the caller's own."""
    if threads == 1:
        return [job() for job in jobs]
    with ThreadPoolExecutor(threads) as pool:
        return [future.result() for future in [pool.submit(job) for job in jobs]]


def _input_error(error: ValidationError, subject: str) -> InputError:
    found, expected = [], []
    for item in error.errors()[:3]:
        key = ".".join(str(part) for part in item["loc"]) or "(whole)"
        if item["type"] == "extra_forbidden":
            found.append(f"unknown key '{key}'")
            expected.append("only documented keys")
        elif item["type"] == "missing":
            found.append(f"key '{key}' is missing")
            expected.append(f"a value for '{key}'")
        elif item["type"] == "union_tag_invalid":
            found.append(f"'{key}' has {item['ctx']['discriminator'].strip(chr(39))} '{item['ctx']['tag']}'")
            expected.append(f"one of {item['ctx']['expected_tags']}")
        else:
            value = repr(item["input"])
            found.append(f"'{key}' is {value if len(value) <= 80 else value[:77] + '...'}")
            expected.append(item["msg"][:1].lower() + item["msg"][1:])
    return InputError(subject, ", ".join(found), ", ".join(dict.fromkeys(expected)))
