"""Measurements are written while the next ones are made: none is lost, and none is named before its file is there."""

import pytest

from planish.errors import InputError
from planish.pipeline.saving import save_each
from test_storage import make_measurement


def test_each_is_named_when_its_file_is_there_and_in_order(tmp_path):
    files = [tmp_path / f"{i}.h5" for i in range(4)]
    named = []
    for file in save_each((make_measurement(i), file, file) for i, file in enumerate(files)):
        assert file.is_file()
        named.append(file)
    assert named == files


def test_what_was_made_before_a_failure_is_written_and_named(tmp_path):
    file = tmp_path / "first.h5"

    def made():
        yield make_measurement(), file, "first"
        raise InputError("second", "found nothing", "a capture")

    saving = save_each(made())
    assert next(saving) == "first"
    assert file.is_file()
    with pytest.raises(InputError, match="second"):
        next(saving)


def test_a_file_that_cannot_be_written_is_an_error(tmp_path):
    (tmp_path / "taken").write_text("")
    with pytest.raises(InputError, match="taken"):
        list(save_each([(make_measurement(), tmp_path / "taken" / "m.h5", 1)]))


def test_nothing_made_is_nothing_written():
    assert list(save_each([])) == []
