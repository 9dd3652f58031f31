"""Files of measurements and JSON: nothing lost, nothing half written, damaged files refused by name."""

import errno
import json
import mmap
from dataclasses import dataclass, field, fields, replace

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from planish import storage
from planish.errors import InputError
from planish.measurement import SCHEMA, Measurement, NoiseModel, View
from planish.rig import Camera, Rig
from planish.rig.parameters import DEVICE_PARAMETERS

HEIGHT, WIDTH = 30, 40


def make_measurement(seed=0):
    rng = np.random.default_rng(seed)

    def random_map(*shape):
        return rng.normal(size=shape).astype(np.float32)

    camera = Camera.make([[50, 0, 20], [0, 50, 15], [0, 0, 1]], [0.1, 0, 0, 0], (WIDTH, HEIGHT), np.eye(4))
    view = View(random_map(HEIGHT, WIDTH), random_map(HEIGHT, WIDTH), None, 12, NoiseModel(0.5, 0.025), 254.0)
    points = random_map(HEIGHT, WIDTH, 3)
    points[:3] = np.nan
    return Measurement(
        "door_1",
        "A",
        Rig({"A": camera}),
        points,
        random_map(HEIGHT, WIDTH),
        rng.integers(0, 256, (HEIGHT, WIDTH)).astype(np.uint16),
        None,
        {"A": view},
        ("A",),
        False,
        (),
        random_map(HEIGHT, WIDTH),
        (0.75, 0.25),
    )


def assert_equal(a, b):
    if isinstance(a, np.ndarray):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)
    elif isinstance(a, Rig):
        assert a.to_json() == b.to_json()
    elif isinstance(a, View):
        for item in fields(a):
            assert_equal(getattr(a, item.name), getattr(b, item.name))
    elif isinstance(a, dict):
        assert list(a) == list(b)
        for key in a:
            assert_equal(a[key], b[key])
    else:
        assert type(a) is type(b)
        assert a == b


def test_a_measurement_survives_its_file_bit_by_bit(tmp_path):
    measurement = make_measurement()
    measurement.save(tmp_path / "m.h5")
    loaded = Measurement.load(tmp_path / "m.h5")
    for item in fields(Measurement):
        assert_equal(getattr(measurement, item.name), getattr(loaded, item.name))


def test_the_maps_of_a_measurement_lie_in_the_file_that_was_read(tmp_path):
    measurement = make_measurement()
    measurement.save(tmp_path / "m.h5")
    content = storage.read_content(tmp_path / "m.h5", SCHEMA)
    loaded = Measurement.of_content(content, tmp_path / "m.h5")
    for maps in (loaded.points_sensor, loaded.rejected, loaded.views["A"].mean, loaded.position_px):
        assert np.shares_memory(maps, content)


@dataclass(frozen=True)
class Numbers:
    values: np.ndarray


def lies_in_a_mapping(array):
    while isinstance(array.base, np.ndarray):
        array = array.base
    return isinstance(array.base, memoryview) and isinstance(array.base.obj, mmap.mmap)


def without_mapping(*_, **__):
    raise OSError(errno.ENODEV, "No such device")


@pytest.mark.parametrize(("count", "mapped"), [(2 * 2**20 - 2000, False), (2 * 2**20, True)])
def test_large_files_are_mapped_and_small_ones_read(tmp_path, count, mapped):
    values = np.arange(count, dtype=float)
    storage.save(tmp_path / "n.h5", Numbers(values), "numbers")
    loaded = storage.load(tmp_path / "n.h5", Numbers, "numbers").values
    np.testing.assert_array_equal(loaded, values)
    assert lies_in_a_mapping(loaded) == mapped
    with pytest.raises(ValueError, match="read-only"):
        loaded[0] = 1


def test_large_files_on_a_drive_that_cannot_map_are_read(tmp_path, monkeypatch):
    values = np.arange(2 * 2**20, dtype=float)
    storage.save(tmp_path / "n.h5", Numbers(values), "numbers")
    monkeypatch.setattr(mmap, "mmap", without_mapping)
    np.testing.assert_array_equal(storage.load(tmp_path / "n.h5", Numbers, "numbers").values, values)


def test_a_mapped_file_may_be_replaced_while_its_values_are_in_use(tmp_path):
    values = np.arange(2 * 2**20, dtype=float)
    storage.save(tmp_path / "n.h5", Numbers(values), "numbers")
    loaded = storage.load(tmp_path / "n.h5", Numbers, "numbers").values
    storage.save(tmp_path / "n.h5", Numbers(np.zeros(3)), "numbers")
    np.testing.assert_array_equal(loaded, values)


@pytest.mark.parametrize(
    "how", [{}, {"chunks": (10,)}, {"compression": "gzip"}, {"dtype": ">f8"}, {"dtype": "f4"}], ids=str
)
def test_arrays_are_read_however_another_program_laid_them_into_the_file(tmp_path, how):
    values = np.arange(3000.0)
    with h5py.File(tmp_path / "n.h5", "w") as file:
        file.attrs["schema"] = "numbers"
        # Of an odd number of bytes: what follows does not begin where its values could be used.
        file["first"] = np.zeros(999, np.uint8)
        file.create_dataset("values", data=values, **how)
    np.testing.assert_array_equal(storage.load(tmp_path / "n.h5", Numbers, "numbers").values, values)


def test_the_file_names_its_arrays_and_units(tmp_path):
    make_measurement().save(tmp_path / "m.h5")
    with h5py.File(tmp_path / "m.h5") as file:
        assert file.attrs["schema"] == SCHEMA
        assert file["points_sensor"].attrs["unit"] == "mm"
        assert file["views/A/white"].attrs["unit"] == "grey level"
        assert file["views/A/noise"].attrs["slope"] == 0.025


def test_the_same_measurement_gives_the_same_bytes(tmp_path):
    for name in ("first.h5", "second.h5"):
        make_measurement().save(tmp_path / name)
    assert storage.sha256(tmp_path / "first.h5") == storage.sha256(tmp_path / "second.h5")


@dataclass(frozen=True)
class Part:
    weight: float
    label: str


@dataclass(frozen=True)
class Everything:
    text: str
    number: int
    flag: bool
    array: np.ndarray = field(metadata={"unit": "mm"})
    nothing: np.ndarray | None
    names: tuple[str, ...]
    parts: tuple[Part, ...]
    by_name: dict[str, Part]


@given(
    st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=20),
    st.integers(-(2**62), 2**62),
    arrays.arrays(
        st.sampled_from([np.float32, np.float64, np.uint8, np.uint16]), arrays.array_shapes(max_dims=3, min_side=0)
    ),
    st.lists(st.floats(allow_nan=False), max_size=12),
)
def test_every_kind_of_field_survives(tmp_path_factory, text, number, array, weights):
    parts = tuple(Part(weight, f"p{i}") for i, weight in enumerate(weights))
    value = Everything(text, number, True, array, None, ("a", text), parts, {p.label: p for p in parts})
    path = tmp_path_factory.mktemp("storage") / "value.h5"
    storage.save(path, value, "test/1")
    loaded = storage.load(path, Everything, "test/1")
    assert_equal(loaded.array, array)
    assert replace(loaded, array=None) == replace(value, array=None)


def test_a_large_rig_covariance_fits_into_the_file(tmp_path):
    rig = make_measurement().rig
    rig = replace(rig, cameras=dict.fromkeys(("A", "B"), rig.cameras["A"]), projector=rig.cameras["A"])
    names = tuple(f"{device}.{name}" for device in rig.devices for name in DEVICE_PARAMETERS)
    covariance = np.full((len(names), len(names)), 1 / 3) + np.diag(np.linspace(0.1, 1 / 3, len(names)))
    rig = replace(rig, covariance=covariance, covariance_parameters=names)
    replace(make_measurement(), rig=rig).save(tmp_path / "m.h5")
    np.testing.assert_array_equal(Measurement.load(tmp_path / "m.h5").rig.covariance, rig.covariance)


def write_half(path):
    with storage.replacing(path) as temporary:
        temporary.write_bytes(b"half")
        raise KeyboardInterrupt


def test_an_interrupted_write_leaves_no_file_and_keeps_the_old_one(tmp_path):
    path = tmp_path / "m.h5"
    with pytest.raises(KeyboardInterrupt):
        write_half(path)
    assert list(tmp_path.iterdir()) == []
    make_measurement(1).save(path)
    before = path.read_bytes()
    with pytest.raises(TypeError):
        storage.save(path, replace(make_measurement(2), views={"A": object()}), SCHEMA)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_json_with_nan_is_not_written(tmp_path):
    with pytest.raises(ValueError, match="JSON"):
        storage.write_json(tmp_path / "a.json", {"x": float("nan")})
    assert list(tmp_path.iterdir()) == []


def test_an_output_folder_that_cannot_be_made_is_named(tmp_path):
    (tmp_path / "out").write_text("a file, not a folder")
    with pytest.raises(InputError, match="cannot be made a folder"):
        storage.write_json(tmp_path / "out" / "a.json", {})


@pytest.mark.parametrize("share", [0.0, 0.01, 0.5, 0.9, 0.999])
def test_a_file_cut_short_is_refused_by_name(tmp_path, share):
    path = tmp_path / "m.h5"
    make_measurement().save(path)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(InputError) as caught:
        Measurement.load(path)
    assert caught.value.subject == str(path)


def damage_attribute(file):
    file.attrs["organised_on"] = "C"


def damage_rig(file):
    file.attrs["rig"] = json.dumps({"schema": "planish.rig/1", "cameras": {}})


def damage_shape(file):
    del file["sigma_mm"]
    file["sigma_mm"] = np.zeros((2, 2), np.float32)


def damage_views(file):
    del file["views"]
    file["views"] = np.zeros(3)


def damage_view_shape(file):
    del file["views/A/white"]
    file["views/A/white"] = np.zeros((HEIGHT, WIDTH + 1), np.float32)


def damage_texture_views(file):
    file.attrs["texture_views"] = json.dumps(["B"])


def damage_missing(file):
    del file["points_sensor"]


@pytest.mark.parametrize(
    ("damage", "named"),
    [
        (damage_attribute, "organised_on"),
        (damage_rig, "cameras.A"),
        (damage_shape, "sigma_mm"),
        (damage_views, "damaged"),
        (damage_view_shape, "views/A/white"),
        (damage_texture_views, "texture_views"),
        (damage_missing, "points_sensor"),
    ],
)
def test_a_measurement_with_wrong_content_is_refused_by_file_and_field(tmp_path, damage, named):
    path = tmp_path / "m.h5"
    make_measurement().save(path)
    with h5py.File(path, "a") as file:
        damage(file)
    with pytest.raises(InputError) as caught:
        Measurement.load(path)
    assert str(path) in str(caught.value)
    assert named in str(caught.value)


def test_a_file_that_is_no_measurement_is_refused(tmp_path):
    (tmp_path / "text.h5").write_text("hello")
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["points_sensor"] = np.zeros(3)
    for name in ("text.h5", "other.h5", "missing.h5", "."):
        with pytest.raises(InputError, match=r"planish\.measurement/1"):
            Measurement.load(tmp_path / name)


@pytest.mark.parametrize("content", [b"", b"{", b"[1, 2]", b"\xff\xfe{}", b"3"])
def test_json_that_holds_no_object_is_refused_by_name(tmp_path, content):
    path = tmp_path / "a.json"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"a\.json"):
        storage.read_json(path)


def test_a_file_without_one_of_its_arrays_is_refused_by_the_name_of_it(tmp_path):
    make_measurement().save(tmp_path / "m.h5")
    with h5py.File(tmp_path / "m.h5", "a") as file:
        del file["sigma_mm"]
    with pytest.raises(InputError, match=r"m\.h5: sigma_mm: is missing; expected a file of this version"):
        Measurement.load(tmp_path / "m.h5")
