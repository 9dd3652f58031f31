"""MAT-files: version 5 against SciPy's reader, version 7.3, and what damaged bytes do: nothing but an error."""

import contextlib
import struct

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.io import loadmat, savemat

from mat_files import OBJECT_REFERENCE, write_v5_object, write_v73
from planish.errors import InputError
from planish.rig.exchange.mat_file import read_mat_file
from planish.rig.exchange.mat_values import MatlabObject, Unread

CONTENT = {
    "row": np.arange(5.0)[None],
    "matrix": np.arange(12, dtype=np.int16).reshape(3, 4),
    "cube": np.arange(24.0).reshape(2, 3, 4),
    "single": np.float32([[1.5, -2.5]]),
    "wide": np.array([[2**63 + 1]], np.uint64),
    "yes": np.array([[True, False]]),
    "empty": np.zeros((0, 2)),
    "s": {"a": np.eye(2), "inner": {"text": "mm", "long_text": "Computer Vision Toolbox", "none": ""}},
}


def assert_same(value, expected):
    """Compare with what SciPy returns with simplify_cells=False."""
    if isinstance(value, dict):
        assert list(value) == list(expected.dtype.names)
        for name, item in value.items():
            assert_same(item, expected[0, 0][name])
    elif isinstance(value, str):
        assert value == "".join(expected.ravel())
    else:
        np.testing.assert_array_equal(value, expected)


@pytest.mark.parametrize("compressed", [False, True], ids=["v6", "v7"])
def test_version_5_reads_as_scipy_reads_it(tmp_path, compressed):
    path = tmp_path / "c.mat"
    savemat(path, CONTENT, do_compression=compressed)
    found, expected = read_mat_file(path), loadmat(path)
    assert list(found) == list(CONTENT)
    for name, value in found.items():
        assert_same(value, expected[name])


def test_version_7_3_is_turned_into_the_shapes_that_matlab_shows(tmp_path):
    content = {name: CONTENT[name] for name in ("row", "cube", "yes", "s")}
    found = read_mat_file(write_v73(tmp_path / "c.mat", **content))
    np.testing.assert_array_equal(found["row"], content["row"])
    np.testing.assert_array_equal(found["cube"], content["cube"])
    np.testing.assert_array_equal(found["yes"], content["yes"])
    assert found["s"]["inner"] == {"text": "mm", "long_text": "Computer Vision Toolbox", "none": ""}


def test_what_no_calibration_is_made_of_is_left_unread(tmp_path):
    savemat(tmp_path / "c.mat", {"z": 1 + 2j, "cell": np.array([[1, "a"]], object), "n": 3.0})
    found = read_mat_file(tmp_path / "c.mat")
    assert (found["z"], found["cell"]) == (Unread(), Unread())
    assert found["n"].tolist() == [[3.0]]


def test_an_object_is_known_by_its_class(tmp_path):
    path = write_v5_object(tmp_path / "o.mat", "params", "stereoParameters")
    assert read_mat_file(path) == {"params": MatlabObject("stereoParameters")}
    assert OBJECT_REFERENCE[0] == 0xDD000000


def test_files_of_the_other_byte_order_are_read(tmp_path):
    def element(kind, data):
        return struct.pack(">II", kind, len(data)) + data + b"\0" * (-len(data) % 8)

    # The name in the short form: size and type in one word.
    array = (
        element(6, struct.pack(">II", 6, 0))
        + element(5, struct.pack(">ii", 1, 2))
        + struct.pack(">HH", 1, 1)
        + b"x\0\0\0"
        + element(9, struct.pack(">dd", 1.5, -2.0))
    )
    head = b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack(">H", 0x0100) + b"MI"
    (tmp_path / "big.mat").write_bytes(head + element(14, array))
    assert read_mat_file(tmp_path / "big.mat")["x"].tolist() == [[1.5, -2.0]]
    assert loadmat(tmp_path / "big.mat")["x"].tolist() == [[1.5, -2.0]]


def damaged(data, cut, changes):
    content = bytearray(data[: max(1, int(cut * len(data)))])
    for place, byte in changes:
        content[int(place * (len(content) - 1))] = byte
    return bytes(content)


@pytest.mark.parametrize("version", ["v6", "v7", "v7.3"])
@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    cut=st.one_of(st.just(1.0), st.floats(0, 1)),
    changes=st.lists(st.tuples(st.floats(0, 1), st.integers(0, 255)), max_size=10),
)
def test_damaged_bytes_make_an_error_or_other_values_and_nothing_else(tmp_path, version, cut, changes):
    path, whole = tmp_path / "c.mat", tmp_path / "whole.mat"
    if not whole.exists():
        if version == "v7.3":
            write_v73(whole, **{name: CONTENT[name] for name in ("row", "yes", "s")})
        else:
            savemat(whole, CONTENT, do_compression=version == "v7")
    path.write_bytes(damaged(whole.read_bytes(), cut, changes))
    # Any other error, and a crash of the process, fails the test.
    with contextlib.suppress(InputError):
        assert isinstance(read_mat_file(path), dict)
