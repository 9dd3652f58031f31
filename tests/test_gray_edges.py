"""Gray code that stands alone: positions between its sub-pixel edges, and their sigma."""

import numpy as np
import pytest

from planish import _core
from planish.errors import InputError
from planish.measurement import REJECTIONS, NoiseModel
from planish.sensing.capture.sequence import read_layouts
from planish.sensing.decode import DecodeOptions
from planish.sensing.decode.gray_edges import local_mean_gain
from planish.sensing.observe import observe
from reference import sensing as reference
from sequences import blurred, gray_entries, manifest

#: Rounding of two grey values of 160, divided by the slope of an edge (0.6 per px), two edges; and its lean [px].
EDGE_PX = 0.03
NOISE = NoiseModel(1.5, 0.02)


def ramp(shape=(60, 400), px_per_pixel=0.8, start=3.3):
    """Positions along the row; the rows are shifted against each other."""
    return start + px_per_pixel * np.arange(shape[1])[None, :] + np.linspace(0, 1.9, shape[0])[:, None]


def decoded(plan, images):
    (layout,) = read_layouts(plan, "test")
    (phase,) = observe({"A": images}.__getitem__, ("A",), layout, DecodeOptions(), "test", 2)["A"].phases.values()
    return phase


def code(bits=9, cell_px=1.0, inverse=True, axis="u", lamp=True):
    entries = [entry | {"axis": axis} for entry in gray_entries(bits, cell_px, inverse)]
    return manifest(entries + ([{"role": "white"}, {"role": "black"}] if lamp else []))


@pytest.mark.parametrize("lamp", [True, False])
@pytest.mark.parametrize("inverse", [True, False])
@pytest.mark.parametrize("cell_px", [1.0, 2.0, 8.0])
def test_positions_lie_between_the_edges_to_a_few_hundredths_of_a_pixel(cell_px, inverse, lamp):
    positions = ramp()
    plan = code(cell_px=cell_px, inverse=inverse, lamp=lamp)
    phase = decoded(plan, blurred(plan.sequence, positions))
    inner = slice(2 + int(cell_px / 0.8), -2 - int(cell_px / 0.8))
    assert np.isfinite(phase.position_px[:, inner]).mean() > 0.99
    assert np.nanmax(np.abs(phase.position_px - positions)[:, inner]) < 2 * EDGE_PX


def test_positions_that_fall_along_the_row_are_found_too():
    positions = ramp()[:, ::-1].copy()
    plan = code()
    phase = decoded(plan, blurred(plan.sequence, positions))
    assert np.nanmax(np.abs(phase.position_px - positions)) < 2 * EDGE_PX


def test_codes_along_v_are_read_along_the_columns():
    positions = ramp()
    plan = code(axis="v")
    images = [np.ascontiguousarray(image.T) for image in blurred(plan.sequence, positions)]
    phase = decoded(plan, images)
    assert phase.axis == "v"
    assert np.nanmax(np.abs(phase.position_px - positions.T)) < 2 * EDGE_PX


@pytest.mark.parametrize(("cell_px", "px_per_pixel"), [(1.0, 0.8), (1.0, 0.6), (4.0, 0.8)])
def test_sigma_is_the_standard_deviation_of_the_position(cell_px, px_per_pixel):
    positions = ramp((300, 400), px_per_pixel)
    plan = code(cell_px=cell_px)
    phase = decoded(plan, blurred(plan.sequence, positions, NOISE))
    normalised = (phase.position_px - positions) / phase.sigma_px
    # Sigma holds the lean of near edges on each other as the other camera feels it: alone it is somewhat too much.
    assert 0.75 < np.nanstd(normalised) < 1.1
    assert np.nanmax(np.abs(normalised)) < 8


def test_bits_that_are_blurred_away_are_left_out():
    """Three camera pixels see ten cells: the last bits hold nothing, the others still count."""
    positions = ramp(px_per_pixel=3.3, shape=(40, 150))
    plan = code(bits=9)
    phase = decoded(plan, blurred(plan.sequence, positions))
    assert np.isfinite(phase.position_px).mean() > 0.9
    assert np.nanmax(np.abs(phase.position_px - positions)) < 3.3 * 2 * EDGE_PX * 3


def test_a_jump_is_not_bridged_and_its_pixels_are_mixed():
    positions = ramp()
    positions[:, 200:] += 40.0
    plan = code()
    phase = decoded(plan, blurred(plan.sequence, positions))
    mixed = (phase.rejected >> REJECTIONS.index("mixed")) & 1 == 1
    assert mixed[:, 198:202].any(axis=1).all()
    off = np.abs(phase.position_px - positions)
    assert np.nanmax(off[:, :197]) < 2 * EDGE_PX
    assert np.nanmax(off[:, 203:]) < 2 * EDGE_PX


def test_pixels_without_light_are_dark():
    positions = ramp()
    plan = code()
    images = blurred(plan.sequence, positions, NOISE)
    for image in images:
        image[20:30] = 12
    phase = decoded(plan, images)
    dark = (phase.rejected >> REJECTIONS.index("dark")) & 1 == 1
    assert dark[20:30].all()
    assert not dark[:20].any()
    assert np.isnan(phase.position_px[20:30]).all()


def test_clipped_light_with_inverse_images_moves_no_edge():
    positions = ramp()
    plan = code()
    clipped = [
        np.minimum(image.astype(int) * 3 // 2, 255).astype(np.uint8) for image in blurred(plan.sequence, positions)
    ]
    phase = decoded(plan, clipped)
    assert np.isfinite(phase.position_px).mean() > 0.98
    assert np.nanmax(np.abs(phase.position_px - positions)) < 3 * EDGE_PX


def test_a_code_that_shows_no_stripes_is_refused():
    plan = code()
    flat = [np.full((40, 60), 90 + (k % 3), np.uint8) for k in range(len(plan.sequence))]
    flat[-1][:] = 5
    with pytest.raises(InputError, match="no Gray bit reaches"):
        decoded(plan, flat)


def test_the_kernel_equals_its_numpy_twin():
    positions = ramp((6, 120))
    plan = code(bits=7)
    images = blurred(plan.sequence, positions, NOISE)[:14]
    found = _core.gray_edges(images[::2] + images[1::2], list(range(7, 14)), -1, -1, 1.0, 255.0, 1.5, 0.02, 0.2, 0.0, 2)
    expected, sigma = reference.gray_edge_positions(np.array(images[::2], float), np.array(images[1::2], float), NOISE)
    assert np.array_equal(np.isfinite(found[0]), np.isfinite(expected))
    # Single precision and the approximated normal score.
    assert np.nanmax(np.abs(found[0] - expected)) < 1e-4
    assert np.nanmax(np.abs(found[1] / sigma - 1)) < 1e-3


def test_the_result_does_not_depend_on_the_number_of_threads():
    plan = code()
    images = blurred(plan.sequence, ramp((37, 200)), NOISE)
    selected = images[0:18:2] + images[1:18:2]
    results = [
        _core.gray_edges(selected, list(range(9, 18)), -1, -1, 1.0, 255.0, 1.5, 0.02, 0.2, 0.0, n) for n in (1, 2, 7)
    ]
    for other in results[1:]:
        assert all(a.tobytes() == b.tobytes() for a, b in zip(results[0], other, strict=True))


@pytest.mark.parametrize("spacing", [1.25, 5.0])
def test_the_gain_of_a_local_mean_is_that_of_simulated_edges(spacing):
    rng = np.random.default_rng(5)
    edges = np.arange(0, 400, spacing)[None] + rng.uniform(0, spacing, (500, 1))
    errors = rng.standard_normal(edges.shape)
    lines = np.array([np.interp(np.arange(10, 380), e, x) for e, x in zip(edges, errors, strict=True)])
    # The cubic B-spline at a quarter of a pixel.
    g = 0.25
    weights = np.array([(1 - g) ** 3, 4 - 6 * g**2 + 3 * g**3, 1 + 3 * g + 3 * g**2 - 3 * g**3, g**3]) / 6
    means = sum(w * lines[:, k : k + 360] for k, w in enumerate(weights))
    measured = means.std() / (lines.std() * np.sqrt((weights**2).sum()))
    assert local_mean_gain(np.tile(np.arange(300) / spacing, (20, 1)).astype(np.float32), 1.0) == pytest.approx(
        measured, rel=0.03
    )
