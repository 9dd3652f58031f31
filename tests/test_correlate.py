"""Temporal correlation of statistical patterns against exact geometry, its NumPy twin, and its own sigma."""

import numpy as np
import pytest

from planish.geometry import compose, exp_so3
from planish.measurement import REJECTIONS, NoiseModel
from planish.rig import Camera
from planish.sensing.capture.manifest import Box
from planish.sensing.patterns.statistical import statistical_profile
from planish.sensing.points.correlate import CorrelateOptions, correlate, temporal_view
from reference import correlate as reference
from sequences import plane_points, small_rig

#: Shortest period [projector px]: about 17 camera pixels, as on the reference sensor.
PERIOD_PX, STEPS = 24.0, 12
#: Photon transfer of an 8-bit camera, and of images without noise but their rounding to 16 bit.
NOISE, SILENT = NoiseModel(1.5, 0.025), NoiseModel(1 / 12, 0.0)
#: What interpolation between the pixels leaves without noise [px]: unit vectors of 12 steps hold harmonics.
#: Its standard deviation is an eighth of that.
INTERPOLATION_PX = 1e-2


def shown(positions, steps=STEPS, seed=1):
    """Brightness (N, H, W) of all patterns at projector positions (H, W)."""
    return np.stack([statistical_profile(positions, k, seed, PERIOD_PX) for k in range(steps)])


def camera_images(brightness, *, offset=20.0, amplitude=160.0, noise=None, seed=0):
    """8-bit images with noise; without noise, 16-bit ones of full range."""
    grey = offset + amplitude * brightness
    if noise is None:
        return list(np.clip(np.round(grey * 256), 0, 65535).astype(np.uint16))
    rng = np.random.default_rng(seed)
    # Rounding adds 1/12 to the variance that the noise model states.
    spread = np.sqrt(noise.offset - 1 / 12 + noise.slope * np.maximum(grey, 0))
    return list(np.clip(np.round(grey + spread * rng.standard_normal(grey.shape)), 0, 255).astype(np.uint8))


def positions(rig, **more):
    return {n: rig.projector.project(plane_points(c, **more))[..., 0] for n, c in rig.cameras.items()}


def run(rig, images, noise=NOISE, own="A", threads=2, options=None, volume=None):
    other = rig.other(own)
    full = 255.0 if images[own][0].dtype == np.uint8 else 65535.0
    return correlate(
        images[own], images[other], rig.cameras[own], rig.cameras[other], noise, noise, (full, full),
        options or CorrelateOptions(), threads, volume,
    )  # fmt: skip


def truth_of(rig, own="A", margin=3):
    other = rig.cameras[rig.other(own)]
    pixels = other.project(plane_points(rig.cameras[own]))
    inside = (pixels >= margin).all(-1) & (pixels <= np.array(other.size_px) - 1 - margin).all(-1)
    return pixels, inside


def has(rejected, reason):
    return (rejected >> REJECTIONS.index(reason)) & 1 == 1


def normalised(pairs, truth):
    return (pairs.pixel_px[..., 0] - truth[..., 0]) / pairs.sigma_px


@pytest.mark.parametrize("own", ["A", "B"])
def test_correspondences_of_a_plane_are_exact_with_distortion(own):
    rig = small_rig()
    images = {n: camera_images(shown(p)) for n, p in positions(rig).items()}
    truth, inside = truth_of(rig, own)
    pairs, rejected = run(rig, images, SILENT, own)
    assert (rejected[inside] == 0).all()
    assert np.abs(pairs.pixel_px - truth)[inside].max() < INTERPOLATION_PX


def test_rigs_with_upright_epipolar_lines_give_the_same_points():
    rig = small_rig()
    turn = exp_so3([0, 0, np.pi / 2])
    upright = {}
    for name, camera in rig.cameras.items():
        K = camera.K.copy()
        K[0, 2], K[1, 2] = camera.size_px[1] / 2, camera.size_px[0] / 2
        T = compose(turn, [0, 0, 0]) @ camera.T_camera_sensor
        upright[name] = Camera.make(K, camera.distortion, camera.size_px[::-1], T)
    turned = type(rig)(upright, rig.projector)
    images = {n: camera_images(shown(p)) for n, p in positions(turned).items()}
    truth, inside = truth_of(turned)
    pairs, _ = run(turned, images, SILENT)
    assert inside.mean() > 0.5
    assert np.abs(pairs.pixel_px - truth)[inside].max() < INTERPOLATION_PX


def test_the_kernel_finds_what_brute_force_finds():
    rig = small_rig()
    images = {n: camera_images(shown(p), noise=NOISE, seed=i) for i, (n, p) in enumerate(positions(rig).items())}
    _, inside = truth_of(rig, margin=7)
    pairs, _ = run(rig, images)
    for v, u in np.argwhere(inside)[::1999]:
        expected, _ = reference.best_correlation(images["A"], images["B"], *rig.cameras.values(), u, v)
        # The twin does not take the noise out of the template: a few hundredths of sigma.
        assert np.abs(pairs.pixel_px[v, u] - expected).max() < 0.15 * pairs.sigma_px[v, u]


@pytest.mark.parametrize("amplitude", [160.0, 40.0])
def test_no_place_between_the_pixels_is_preferred(amplitude):
    rig = small_rig()
    images = {
        n: camera_images(shown(p), amplitude=amplitude, noise=NOISE, seed=i)
        for i, (n, p) in enumerate(positions(rig).items())
    }
    truth, _ = truth_of(rig)
    pairs, _ = run(rig, images)
    z, fraction = normalised(pairs, truth), np.mod(truth[..., 0], 1)
    bins = [z[np.isfinite(z) & (np.floor(8 * fraction) == i)] for i in range(8)]
    assert min(len(values) for values in bins) > 1500
    # 1,500 points: the standard error of a mean is 0.026 sigma.
    assert max(abs(values.mean()) for values in bins) < 0.1


def test_normalised_errors_have_unit_variance_in_every_decile_of_modulation():
    rig = small_rig()
    rng = np.random.default_rng(4)
    albedo = np.exp(rng.uniform(np.log(0.1), 0, (1, 150, 200)))
    errors, modulation = [], []
    for seed in range(3):
        images = {
            n: camera_images(shown(p) * (albedo if n == "A" else 0.7), noise=NOISE, seed=2 * seed + (n == "A"))
            for n, p in positions(rig).items()
        }
        truth, _ = truth_of(rig)
        pairs, _ = run(rig, images)
        z = normalised(pairs, truth)
        errors.append(z[np.isfinite(z)])
        modulation.append(temporal_view(images["A"], NOISE, 255.0, 2).modulation[np.isfinite(z)])
    z, m = np.concatenate(errors), np.concatenate(modulation)
    assert np.abs(z).max() < 10
    for part in np.array_split(z[np.argsort(m)], 10):
        assert part.std() == pytest.approx(1.0, abs=0.1)
    assert z.std() == pytest.approx(1.0, abs=0.04)


def test_saturated_steps_are_left_out():
    rig = small_rig()
    where = positions(rig)
    bright = {n: shown(p) * np.where(p % 60 < 30, 1.6, 1.0) for n, p in where.items()}
    images = {n: camera_images(b, noise=NOISE, seed=i) for i, (n, b) in enumerate(bright.items())}
    count = (np.array(images["A"]) == 255).sum(0)
    truth, inside = truth_of(rig)
    pairs, rejected = run(rig, images)
    z = normalised(pairs, truth)
    few = inside & (count > 0) & (count <= STEPS - 8)
    assert few.sum() > 2000
    assert np.isfinite(z[few]).mean() > 0.9
    assert np.nanstd(z[few]) == pytest.approx(1.0, abs=0.1)
    assert np.nanmax(np.abs(z)) < 10
    assert has(rejected, "saturated")[count > STEPS - 6].all()
    assert not has(rejected, "saturated")[count <= STEPS - 6].any()


def test_pixels_without_a_partner_get_no_point():
    rig = small_rig()
    where = positions(rig)
    own = shown(where["A"])
    own[:, 40:80] = shown(where["A"][40:80], seed=9)  # hidden from the other camera, which sees something else
    own[:, 100:120] = 0.5
    mixed = 0.5 * own[:, 130:140] + 0.5 * shown(where["A"][130:140] + 90)
    own[:, 130:140] = mixed
    images = {"A": camera_images(own, noise=NOISE), "B": camera_images(shown(where["B"]), noise=NOISE, seed=1)}
    truth, inside = truth_of(rig)
    pairs, rejected = run(rig, images)
    assert (rejected[40:80] != 0).all()
    assert has(rejected, "unmatched")[40:80][inside[40:80]].mean() > 0.99
    assert (rejected[100:120] != 0).all()
    assert has(rejected, "dark")[100:120].mean() > 0.95
    assert (rejected[130:140] != 0).mean() > 0.999
    rest = inside.copy()
    rest[40:80] = rest[100:120] = rest[130:140] = False
    assert (rejected[rest] == 0).mean() > 0.999
    assert np.isnan(pairs.pixel_px[rejected != 0]).all()
    assert np.abs(normalised(pairs, truth)[rest & (rejected == 0)]).max() < 10


def test_patterns_that_repeat_are_told_from_aperiodic_ones():
    rig = small_rig()
    angle = 2 * np.pi * np.arange(STEPS)[:, None, None] / STEPS
    images = {
        n: camera_images(0.5 + 0.5 * np.cos(2 * np.pi * p / PERIOD_PX - angle), noise=NOISE)
        for n, p in positions(rig).items()
    }
    _, inside = truth_of(rig)
    _, rejected = run(rig, images)
    assert has(rejected, "ambiguous")[inside].mean() > 0.99


def test_brightness_and_offset_of_a_camera_change_nothing():
    rig = small_rig()
    images = {n: camera_images(shown(p)) for n, p in positions(rig).items()}
    before, _ = run(rig, images, SILENT)
    images["B"] = [(image // 2 + 3000).astype(np.uint16) for image in images["B"]]
    after, _ = run(rig, images, SILENT)
    assert np.nanmax(np.abs(before.pixel_px - after.pixel_px)) < INTERPOLATION_PX


def test_the_order_of_the_images_changes_nothing():
    rig = small_rig()
    images = {n: camera_images(shown(p), noise=NOISE) for n, p in positions(rig).items()}
    order = np.random.default_rng(1).permutation(STEPS)
    before, _ = run(rig, images)
    after, _ = run(rig, {n: [stack[k] for k in order] for n, stack in images.items()})
    assert np.nanmax(np.abs(before.pixel_px - after.pixel_px)) < 1e-3  # order of the sums


def test_a_volume_limits_the_search():
    rig = small_rig()
    images = {n: camera_images(shown(p), noise=NOISE) for n, p in positions(rig).items()}
    free, _ = run(rig, images)
    box = Box(min=(-60, -500, -60), max=(60, 500, 60))
    limited, rejected = run(rig, images, volume=box)
    points = plane_points(rig.cameras["A"])
    inside = (np.abs(points[..., [0, 2]]) < 55).all(-1)
    assert inside.sum() > 3000
    assert np.array_equal(limited.pixel_px[inside], free.pixel_px[inside], equal_nan=True)
    assert has(rejected, "masked")[np.abs(points[..., 0]) > 140].mean() > 0.9
    far = Box(min=(-500, -500, 200), max=(500, 500, 300))
    nothing, _ = run(rig, images, volume=far)
    kept = np.isfinite(nothing.pixel_px[..., 0])
    # The range is rounded up to whole blocks of columns: what is still found is what is there.
    assert kept.mean() < 0.05
    assert np.abs(nothing.pixel_px[kept] - free.pixel_px[kept]).max() < INTERPOLATION_PX


def test_the_result_does_not_depend_on_the_number_of_threads():
    rig = small_rig()
    images = {n: camera_images(shown(p), noise=NOISE) for n, p in positions(rig).items()}
    results = [run(rig, images, threads=n) for n in (1, 2, 7)]
    for pairs, rejected in results[1:]:
        assert pairs.pixel_px.tobytes() == results[0][0].pixel_px.tobytes()
        assert pairs.sigma_px.tobytes() == results[0][0].sigma_px.tobytes()
        assert rejected.tobytes() == results[0][1].tobytes()


def test_a_view_holds_mean_and_amplitude():
    positions_px = np.random.default_rng(2).uniform(0, 320, (40, 50))
    images = camera_images(shown(positions_px, steps=40))
    view = temporal_view(images, NOISE, 65535.0, 2)
    stack = np.array(images, float)
    assert view.mean == pytest.approx(stack.mean(0), rel=1e-5)
    assert view.modulation == pytest.approx(np.sqrt(2) * stack.std(0), rel=1e-5)
    # 40 cosines of random phase: their amplitude within 10 %.
    assert np.median(view.modulation) == pytest.approx(80 * 256, rel=0.1)


@pytest.mark.parametrize(("own", "other"), [(12, 11), (5, 5), (0, 0)])
def test_sequences_that_do_not_fit_are_refused(own, other):
    rig = small_rig()
    images = camera_images(shown(positions(rig)["A"]))
    with pytest.raises(ValueError, match="same number"):
        correlate(images[:own], images[:other], *rig.cameras.values(), NOISE, NOISE, (255, 255), CorrelateOptions(), 1)


def test_images_of_another_size_are_refused():
    rig = small_rig()
    images = camera_images(shown(positions(rig)["A"]))
    with pytest.raises(ValueError, match="as its camera"):
        run(rig, {"A": images, "B": [image[:-1] for image in images]})
