"""Everything read from outside: unknown keys, wrong types and non-finite numbers are refused with a clear message."""

import math
import pickle
from pathlib import Path

import pytest
from pydantic import Field, ValidationError

from planish import options
from planish.errors import InputError


class Example(options.Options):
    window_px: int = Field(default=5, ge=1)
    max_error_mm: float = 0.5
    ratio: float = Field(default=0.8, gt=0, lt=1)


def test_defaults_and_given_values_are_kept():
    assert Example.parse({"window_px": 7}, "options") == Example(window_px=7, max_error_mm=0.5)


@pytest.mark.parametrize(
    ("values", "found", "expected"),
    [
        ({"max_error": 1.0}, "unknown key 'max_error'", "only documented keys"),
        ({"window_px": 0}, "'window_px' is 0", "greater than or equal to 1"),
        ({"ratio": 1.5}, "'ratio' is 1.5", "less than 1"),
        ({"window_px": 2.5}, "'window_px' is 2.5", "integer"),
        ({"max_error_mm": math.nan}, "'max_error_mm' is nan", "finite"),
        ({"max_error_mm": math.inf}, "'max_error_mm' is inf", "finite"),
        ({"max_error_mm": "much"}, "'max_error_mm' is 'much'", "number"),
        ([1, 2], "'(whole)' is [1, 2]", "dictionary"),
    ],
)
def test_wrong_values_are_refused_with_file_key_found_and_expected(values, found, expected):
    with pytest.raises(InputError) as caught:
        Example.parse(values, "settings.json")
    assert caught.value.subject == "settings.json"
    assert found in caught.value.found
    assert expected in caught.value.expected


def test_a_long_wrong_value_is_shortened_in_the_message():
    with pytest.raises(InputError) as caught:
        Example.parse({"window_px": "x" * 1000}, "options")
    assert len(str(caught.value)) < 250


def test_options_cannot_be_changed_after_the_check():
    with pytest.raises(ValidationError):
        Example().ratio = 0.5


def test_the_number_of_threads_is_the_argument_then_the_environment_then_the_processors(monkeypatch):
    monkeypatch.setenv("PLANISH_THREADS", "3")
    assert options.thread_count(2) == 2
    assert options.thread_count() == 3
    monkeypatch.delenv("PLANISH_THREADS")
    assert options.thread_count() >= 1


@pytest.mark.parametrize("text", ["", "two", "-1", "0", "1.5", "²"])
def test_a_wrong_number_of_threads_in_the_environment_is_refused(monkeypatch, text):
    monkeypatch.setenv("PLANISH_THREADS", text)
    with pytest.raises(InputError, match="whole number >= 1"):
        options.thread_count()


def test_no_threads_at_all_are_refused():
    with pytest.raises(InputError, match="threads: found 0"):
        options.thread_count(0)


def test_an_input_error_passes_from_one_process_to_another():
    error = InputError(Path("a.json"), "found nothing", "something")
    again = pickle.loads(pickle.dumps(error))
    assert (type(again), str(again)) == (InputError, str(error))
    assert (again.subject, again.found, again.expected) == ("a.json", "found nothing", "something")
