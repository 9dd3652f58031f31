"""Local contrast: the texture without light, shape and exposure, and its stated noise."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

import sheets
from planish.geometry import translation
from planish.measurement import NoiseModel, View
from planish.registration.surface import fit_surface
from planish.registration.texture.lowpass import Lowpass
from planish.registration.texture.photometric import local_contrast
from planish.registration.texture.shading import projector_shading
from planish.rig import Rig

#: float32 arithmetic of values near 1.
ROUNDING = 2e-6
#: Shading of 30 % over the image leaves its slope within the low-pass window: second order, far below the grain.
SHADING_SHARE = 0.03
#: A mean of one side would be off by the slope of the light over 0.8 deviations of the window; corners hold less yet.
RIM_SHARE = 0.1
#: Blocks of one pixel.
EVERY_PIXEL = Lowpass(2.0, 1, 1)


def with_image(m, image, noise=None, **changes):
    view = replace(m.views["A"], mean=image.astype(np.float32), **changes)
    return replace(m, views={"A": view if noise is None else replace(view, noise=noise)})


@pytest.fixture(scope="module")
def clean():
    return sheets.quiet("a")


def test_gain_and_exposure_change_neither_contrast_nor_its_sigma(clean):
    value, sigma = local_contrast(clean)
    image, noise = clean.views["A"].mean, clean.views["A"].noise
    brighter = with_image(clean, 1.7 * image, NoiseModel(noise.offset * 1.7**2, noise.slope * 1.7))
    value_bright, sigma_bright = local_contrast(brighter)
    np.testing.assert_allclose(value_bright, value, atol=ROUNDING)
    np.testing.assert_allclose(sigma_bright, sigma, rtol=1e-4)


def test_slow_shading_leaves_the_contrast(clean):
    value, _ = local_contrast(clean)
    rows, columns = np.indices(clean.shape) / np.array(clean.shape)[:, None, None]
    shading = (1 + 0.3 * columns) * (1 - 0.2 * (rows - 0.4) ** 2)
    shaded, _ = local_contrast(with_image(clean, clean.views["A"].mean * shading))
    assert np.nanstd(shaded - value) < SHADING_SHARE * np.nanstd(value)


def test_another_lamp_leaves_the_contrast_within_its_noise(clean):
    value, sigma = local_contrast(clean)
    columns = np.indices(clean.shape)[1] / clean.shape[1]
    lit, _ = local_contrast(with_image(clean, clean.views["A"].mean * (0.4 + 1.2 * columns)))
    assert np.nanstd(lit - value) < 0.5 * np.nanmedian(sigma)
    # Light that the texture does not shape makes it paler, by its share of the light; the picture stays the same.
    offset, _ = local_contrast(with_image(clean, clean.views["A"].mean + 20))
    known = np.isfinite(value)
    assert np.corrcoef(value[known], offset[known])[0, 1] > 0.9999
    paler = float((value[known] @ offset[known]) / (value[known] @ value[known]))
    assert paler == pytest.approx(100 / 120, abs=0.01)


def with_all_kinds(clean, seed, third_harmonic=0.0):
    """White, mean and modulation of three times four-step fringes with their joint noise."""
    rng, albedo = np.random.default_rng(seed), clean.views["A"].mean / 100
    columns = np.indices(clean.shape)[1]
    images, steps = [], np.arange(4)
    for period in (7.0, 29.0, 101.0):
        phase = 2 * np.pi * columns / period
        light = [95 + 85 * np.cos(phase - np.pi / 2 * k) for k in steps]
        light = [
            level + third_harmonic * np.cos(3 * (phase - np.pi / 2 * k)) for level, k in zip(light, steps, strict=True)
        ]
        images += [albedo * level for level in light]
    images = [i + np.sqrt(sheets.NOISE.variance(i)) * rng.standard_normal(i.shape) for i in images]
    amplitudes = [np.abs(sum(images[4 * p + k] * np.exp(0.5j * np.pi * k) for k in steps)) / 2 for p in range(3)]
    white = 180 * albedo
    white = white + np.sqrt(sheets.NOISE.variance(white)) * rng.standard_normal(white.shape)
    kinds = {"white": white, "modulation": np.mean(amplitudes, axis=0)}
    return with_image(
        clean, np.mean(images, axis=0), sheets.NOISE, mean_images=12,
        **{name: image.astype(np.float32) for name, image in kinds.items()},
    )  # fmt: skip


def test_the_noise_that_mean_and_modulation_share_is_counted_once(clean):
    taken = [with_all_kinds(clean, seed) for seed in range(12)]
    values, sigmas = zip(*map(local_contrast, taken), strict=True)
    inner = np.s_[10:-10, 10:-10]
    scatter = np.sqrt(np.var(values, axis=0, ddof=1)[inner].mean())
    stated = np.sqrt(np.mean(np.square(sigmas)[:, inner[0], inner[1]]))
    assert scatter == pytest.approx(stated, rel=0.04)
    alone = local_contrast(with_image(clean, taken[0].views["A"].mean))[1]
    assert stated < 0.95 * np.nanmedian(alone)


def test_modulation_that_holds_residual_fringes_counts_less(clean):
    """A harmonic of 4 % makes the amplitude of four steps wave by as much as the noise; the mean stays free of it."""
    value, _ = local_contrast(clean)

    def error(fringes):
        return np.nanstd((local_contrast(with_all_kinds(clean, 3, fringes))[0] - value)[10:-10, 10:-10])

    assert error(4.0) < 1.1 * error(0.0)


def test_a_surface_without_texture_has_no_contrast(clean):
    value, _ = local_contrast(with_image(clean, np.full(clean.shape, 90.0)))
    assert np.nanmax(np.abs(value)) < ROUNDING


def test_the_contrast_is_the_relative_deviation_of_the_albedo(clean):
    # One bright line a pixel wide in a bright plate: the low-pass hardly notices it.
    image = np.full(clean.shape, 100.0)
    image[:, 150] = 104.0
    value, _ = local_contrast(with_image(clean, image))
    # The low-pass of 2.5 mm (1.9 px) spreads the line's 4 % over 4.8 px: 0.83 % of it stands in its own surroundings.
    # The second pass takes as much of what is left: 1 - 2 g(0) + (g * g)(0) remains.
    bell, twice = 1 / (np.sqrt(2 * np.pi) * 1.92), 1 / (np.sqrt(4 * np.pi) * 1.92)
    assert np.nanmedian(value[:, 150]) == pytest.approx(0.04 * (1 - 2 * bell + twice), abs=3e-3)
    assert np.nanmax(np.abs(value[:, :130])) < ROUNDING


def test_the_stated_sigma_is_the_scatter_of_the_contrast(clean):
    values, sigmas = zip(*(local_contrast(sheets.noisy(clean, seed)) for seed in range(24)), strict=True)
    scatter, stated = np.std(values, axis=0, ddof=1), np.mean(sigmas, axis=0)
    ratio = np.sqrt(np.nanmean(scatter[10:-10, 10:-10] ** 2) / np.nanmean(stated[10:-10, 10:-10] ** 2))
    # What the low-pass takes along of a pixel's own noise (1 / (4 pi 1.9^2), doubled) is not counted: 4 % at most.
    assert 0.93 < ratio < 1.01


def test_white_image_and_fringe_mean_are_combined_by_their_noise(clean):
    image = clean.views["A"].mean
    rng = np.random.default_rng(1)
    deviation = np.sqrt(sheets.NOISE.variance(image))
    white = (image + deviation * rng.standard_normal(image.shape)).astype(np.float32)
    _, alone = local_contrast(clean)
    _, both = local_contrast(with_image(clean, image, white=white))
    # 12 images against 13.
    assert np.nanmedian(alone / both) == pytest.approx(np.sqrt(13 / 12), rel=2e-3)


def test_a_saturated_white_image_does_not_count(clean):
    image = clean.views["A"].mean
    white = image.copy()
    white[100:140, 100:140] = 255
    value, sigma = local_contrast(with_image(clean, image, white=white))
    alone, sigma_alone = local_contrast(clean)
    # The fringe mean rules there, and the saturated region must not pull the low-pass of its surroundings.
    np.testing.assert_allclose(value[110:130, 110:130], alone[110:130, 110:130], atol=1e-4)
    np.testing.assert_allclose(sigma[110:130, 110:130], sigma_alone[110:130, 110:130], rtol=1e-4)


def test_the_second_view_is_brought_over_by_the_correspondence(clean):
    image = clean.views["A"].mean
    rows, columns = np.indices(clean.shape).astype(np.float32)
    shifted = np.roll(image, 7, axis=1)
    two = replace(
        clean,
        rig=Rig({"A": clean.camera, "B": clean.camera}),
        views={"A": clean.views["A"], "B": View(None, shifted, None, 12, sheets.NOISE, 250.0)},
        correspondence_px=np.stack([columns + 7, rows], -1),
        texture_views=("A", "B"),
    )
    value, sigma = local_contrast(two)
    alone, sigma_alone = local_contrast(clean)
    inside = np.s_[12:-12, 12:-24]
    np.testing.assert_allclose(value[inside], alone[inside], atol=1e-3)
    np.testing.assert_allclose(sigma_alone[inside] / sigma[inside], np.sqrt(2), rtol=0.01)


def test_no_contrast_stands_where_there_is_no_point(clean):
    points = clean.points_sensor.copy()
    points[30:60, 40:90] = np.nan
    value, sigma = local_contrast(replace(clean, points_sensor=points))
    assert np.isnan(value[30:60, 40:90]).all()
    assert np.isnan(sigma[30:60, 40:90]).all()
    assert np.isfinite(value[70:, 100:]).all()


#: Standard deviation that may be left of pure shading: a fiftieth of a texture of 0.1 %.
LEFT_OF_SHADING = 2e-5


def lit_by_a_projector(m, room=0.0):
    """The measurement under a projector near its sheet, image = shading alone, with and without room light."""
    centre = np.array([150.0, -60.0, 260.0])
    projector = replace(m.camera, T_camera_sensor=translation(-centre))
    to_light = centre - m.points_sensor.astype(float)
    squared = (to_light**2).sum(-1)
    normals = fit_surface(m).normals_sensor.astype(float)
    irradiance = (normals * to_light).sum(-1) / squared**1.5 * 1e7
    view = replace(m.views["A"], mean=(irradiance / 2 + room).astype(np.float32), white=irradiance.astype(np.float32))
    return replace(m, rig=Rig(m.rig.cameras, projector), views={"A": view}), irradiance


@pytest.mark.parametrize("room", [0.0, 60.0])
def test_the_projectors_light_on_a_bent_sheet_is_not_taken_for_texture(room):
    m, irradiance = lit_by_a_projector(sheets.quiet("a", 1 / 300), room)
    blind = replace(m, rig=Rig(m.rig.cameras))
    # Grazing light is not predicted, and beside it the low-pass mixes both.
    lit = cv2.erode((irradiance > 0.4 * np.nanmax(irradiance)).astype(np.uint8), np.ones((15, 15))) > 0
    with_model, without = (np.nanstd(local_contrast(x)[0][lit]) for x in (m, blind))
    assert with_model < LEFT_OF_SHADING
    # The model takes part of what both passes of the low-pass leave of it.
    assert with_model < 0.8 * without


def test_the_shading_follows_the_cosine_and_the_square_of_the_distance():
    m, irradiance = lit_by_a_projector(sheets.quiet("a", 0.0))
    (shading,) = projector_shading(m, fit_surface(m), EVERY_PIXEL, (3.0,))
    ratio = shading / irradiance
    inner = ratio[10:-10, 10:-10]
    # Noise of the points turns the averaged normals by less than a milliradian.
    assert np.nanstd(inner) < 2e-3 * np.nanmean(inner)


def test_the_low_pass_follows_the_light_up_to_the_rim():
    rows, columns = np.indices((60, 80), dtype=np.float32)
    light = 100 + 0.5 * columns - 0.3 * rows
    # A rim that runs slantwise, so that nothing cancels along rows or columns.
    image = np.where(columns + 0.3 * rows > 30, light, np.float32(np.nan))
    level = EVERY_PIXEL(image)
    known = np.isfinite(image)
    assert np.abs(level - light)[known].max() < RIM_SHARE * 0.5 * EVERY_PIXEL.sigma_px


def test_where_one_camera_sees_a_highlight_the_other_one_counts():
    m = sheets.quiet("a", 0.0)
    rows, columns = np.indices(m.shape)
    spot = 80.0 * np.exp(-((columns - 170) ** 2 + (rows - 130) ** 2) / (2 * 25.0**2))
    # A highlight with structure of its own: it must not become texture.
    structure = 1 + 0.1 * np.sin(columns / 1.5)
    dull = m.views["A"]
    shiny = replace(dull, mean=(dull.mean + spot * structure).astype(np.float32))
    own = np.stack([columns, rows], -1).astype(np.float32)
    both = replace(m, rig=Rig({"A": m.camera, "B": m.camera}), correspondence_px=own,
                   views={"A": shiny, "B": dull}, texture_views=("A", "B"))  # fmt: skip
    truth = local_contrast(m)[0]
    in_spot = np.s_[120:140, 160:180]
    alone = replace(both, texture_views=("A",))
    wrong, mended = (np.nanstd((local_contrast(x)[0] - truth)[in_spot]) for x in (alone, both))
    assert mended < 0.1 * wrong
