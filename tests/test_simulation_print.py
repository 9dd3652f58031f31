from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import minimum_filter

from planish.errors import InputError
from planish.sensing.patterns.entries import Black
from planish.simulation.light import Light
from planish.simulation.printed import Print, raster_print
from planish.simulation.render import render_capture, trace_capture
from planish.simulation.scenes import make_scene
from planish.simulation.texture import BLANK
from reference import render as reference
from reference import surface_print

#: Factors are float32 in the kernel.
FLOAT32 = 1e-6
#: A footprint is averaged as a box of its second moments; against its own shape an edge of full contrast differs by
#: this share where it crosses a corner of the footprint, a cell's corner by twice that.
BOX_SHARE = 0.06
#: Of 170 grey levels between light and dark: what the twin's own points, 24 per pixel and axis, miss at edges.
GREY_LEVELS = 0.8


def random_print(rng, repeat=(False, False)):
    discs = np.column_stack([rng.uniform(-20, 20, (12, 2)), rng.uniform(0.5, 4, 12), rng.uniform(0, 1.5, 12)])
    angle = 0.3
    turned = np.array([[np.cos(angle), np.sin(angle)], [np.sin(angle), -np.cos(angle)]])
    return Print(
        np.cumsum(rng.uniform(0.4, 4, 14)) - 15,
        np.cumsum(rng.uniform(0.4, 4, 11)) - 12,
        rng.uniform(0, 1.5, (10, 13)),
        discs,
        np.column_stack([turned, [1.5, -0.5]]),
        repeat,
    )


@pytest.mark.parametrize("repeat", [(False, False), (True, False), (True, True)])
def test_the_factor_at_a_point_is_that_of_its_cell_or_disc(repeat):
    rng = np.random.default_rng(0)
    printed = random_print(rng, repeat)
    st = rng.uniform(-60, 60, (5000, 2))
    assert np.abs(printed.factor(st) - surface_print.factor(printed, st)).max() < FLOAT32


def test_the_factor_over_a_footprint_is_its_mean():
    rng = np.random.default_rng(1)
    printed = random_print(rng, (True, True))
    st = rng.uniform(-60, 60, (300, 2))
    spans = rng.uniform(-0.3, 0.3, (300, 4))
    fine = (np.stack(np.meshgrid(np.arange(40), np.arange(40)), -1).reshape(-1, 2) + 0.5) / 40 - 0.5
    mean = [surface_print.factor(printed, p + fine @ s.reshape(2, 2)).mean() for p, s in zip(st, spans, strict=True)]
    difference = printed.factor(st, spans) - np.array(mean)
    assert np.abs(difference).max() < 4 * BOX_SHARE
    assert np.sqrt((difference**2).mean()) < BOX_SHARE / 2
    # No bias: what one footprint has too much, others have too little.
    assert abs(difference.mean()) < 4 * difference.std() / np.sqrt(len(st))


def test_a_raster_lies_as_it_is_printed_and_repeats():
    printed = raster_print([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]], (2.0, 3.0), (10.0, 5.0), (True, False))
    st = np.array([[11.0, 3.5], [15.0, 3.5], [13.0, -0.5], [9.0, 3.5], [17.0, 3.5], [11.0, 5.5], [11.0, -1.5]])
    assert np.allclose(printed.factor(st), [0.1, 0.3, 0.5, 0.3, 0.1, 1, 1])


def test_a_printed_part_is_rendered_as_its_twin_says():
    rng = np.random.default_rng(2)
    scene = make_scene("cylinder", 2, scale=0.25)
    printed = raster_print(rng.integers(0, 2, (40, 40)) * 0.9 + 0.1, (4.0, 4.0), repeat=(True, True))
    sensor = replace(scene.sensor, bits=16, noise_factor=0)
    scene = replace(scene, texture=BLANK, printed=printed, sensor=sensor, light=Light(ambient=1.0))
    black = Black(role="black")
    image = render_capture(replace(scene, sequence=(black,)), 0, 2)["A"][0] / 257
    fine = replace(scene, sensor=replace(sensor, samples_per_px=24))
    away_from_edges = minimum_filter(trace_capture(scene, 0, "A")[1], 15)
    at = rng.permutation(np.argwhere(away_from_edges))[:15]
    expected = [reference.grey_value(fine, 0, "A", u, v, black) for v, u in at]
    difference = image[at[:, 0], at[:, 1]] - expected
    assert np.ptp(expected) > 100
    assert np.abs(difference).max() < GREY_LEVELS


def test_the_bytes_of_a_printed_part_do_not_depend_on_the_number_of_threads():
    scene = replace(make_scene("pipe", 1, scale=0.1), printed=random_print(np.random.default_rng(3), (True, True)))
    scene = replace(scene, sequence=scene.sequence[-2:])
    one, four = render_capture(scene, 0, 1), render_capture(scene, 0, 4)
    assert all(np.array_equal(one[camera], four[camera]) for camera in "AB")
    plain = render_capture(replace(scene, printed=None), 0, 2)
    assert not np.array_equal(plain["A"], one["A"])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"x_edges_mm": [0.0, 1.0, 1.0]}, "x_edges_mm"),
        ({"y_edges_mm": [0.0]}, "y_edges_mm"),
        ({"factors": np.ones((3, 2))}, "factors"),
        ({"factors": -np.ones((1, 2))}, "negative"),
        ({"discs": [[0.0, 0.0, 0.0, 1.0]]}, "radius > 0"),
        ({"discs": [[0.0, 0.0]]}, "radius > 0"),
        ({"print_surface": np.eye(3)}, "print_surface"),
    ],
)
def test_what_cannot_be_printed_is_refused(changes, message):
    good = {"x_edges_mm": np.arange(3.0), "y_edges_mm": np.arange(2.0), "factors": np.ones((1, 2))}
    with pytest.raises(InputError, match=message):
        Print(**(good | changes))


@pytest.mark.parametrize(
    ("factors", "cell_mm", "message"), [([], (1, 1), "rows, columns"), ([[1.0]], (1, 0), "cell_mm")]
)
def test_a_raster_without_cells_is_refused(factors, cell_mm, message):
    with pytest.raises(InputError, match=message):
        raster_print(factors, cell_mm)
