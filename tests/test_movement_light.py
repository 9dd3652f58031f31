"""Room light on a curved part, however strong, is not taken for movement, and hides none."""

import numpy as np
import pytest

from planish.errors import InputError
from planish.measurement import NoiseModel
from planish.sensing.capture.sequence import read_layouts
from planish.sensing.checks.light import EqualLight
from planish.sensing.checks.movement import check_movement, compare
from planish.sensing.checks.still import Still, Swing, comparable, mean_of, stills, to_compare, white_to_compare
from planish.sensing.patterns.sequences import encode
from sequences import gray_entries, manifest, phase_entries
from textured import SIZE_PX, picture, sequence, texture

NOISE = NoiseModel(1.44 + 1 / 12, 0.025)
#: Beyond three and a half standard deviations one in 450 honest results (of two coordinates) lies.
SIGMAS = 3.5
#: Lamp in shares of the projector's light, and exposure.
LIGHTS = [(0.2, 1.0), (0.5, 1.3), (2.0, 0.5)]
BLACK = {"role": "black"}
MOVED_PX = (0.32, 0.24)


def pipe():
    """What projector and lamp make of an upright pipe (H, W): lit from the middle, and from the left only."""
    across = np.linspace(-0.97, 0.97, SIZE_PX[0])
    facing = np.sqrt(1 - across**2)
    lamp = np.clip(0.6 * facing - 0.8 * across, 0, None)
    return (np.broadcast_to(shade.astype(np.float32), SIZE_PX[::-1]) for shade in (facing, lamp))


def made(more=(), gray=()):
    entries = [*gray, *phase_entries((1280, 160, 20), 4), *more]
    done = manifest(entries, projector_px=[1280, 800])
    return done.sequence, read_layouts(done, "capture.json")


def seen(entries, lamp, exposure, moved_from=None, shift=MOVED_PX, contrast=0.02):
    """Images under the lamp; from image `moved_from` on the texture lies elsewhere."""
    fine = texture(contrast)
    before, after = picture(fine), picture(fine, shift)
    count = len(entries) if moved_from is None else moved_from
    projector, room = pipe()
    pictures = [before if k < count else after for k in range(len(entries))]
    grey = 110 * exposure
    return sequence(entries, pictures, grey=grey * projector, ambient=4 + lamp * grey * room)


def check(images, layouts):
    return check_movement(images, layouts, NOISE, 255.0, "A", "capture.json", 2)


@pytest.mark.parametrize("more", [[{"role": "white"}, BLACK], [{"role": "white"}], []], ids=["black", "white", "none"])
@pytest.mark.parametrize(("lamp", "exposure"), LIGHTS)
def test_a_still_part_under_a_lamp_is_still(lamp, exposure, more):
    entries, layouts = made(more)
    for finding in check(seen(entries, lamp, exposure), layouts):
        assert finding.value is None or finding.value <= SIGMAS * finding.sigma, finding


@pytest.mark.parametrize("more", [[{"role": "white"}, BLACK], []], ids=["black", "none"])
@pytest.mark.parametrize(("lamp", "exposure"), LIGHTS)
def test_a_movement_under_a_lamp_is_refused(lamp, exposure, more):
    entries, layouts = made(more)
    with pytest.raises(InputError, match=r"movement in camera A: 0\.[34]\d \+-"):
        check(seen(entries, lamp, exposure, moved_from=6), layouts)


@pytest.mark.parametrize("more", [[{"role": "white"}, BLACK], [{"role": "white"}]], ids=["black", "white"])
@pytest.mark.parametrize(("lamp", "exposure"), LIGHTS)
def test_a_movement_before_the_white_image_alone_is_refused(lamp, exposure, more):
    entries, layouts = made(more)
    with pytest.raises(InputError, match=r"movement between patterns and white, camera A: 0\.[4-6]\d \+-"):
        check(seen(entries, lamp, exposure, moved_from=12, shift=(0.4, 0.3)), layouts)


@pytest.mark.parametrize("length", [0.0, 0.2, 0.4])
def test_the_movement_of_the_white_image_is_measured_within_its_sigma(length):
    entries, layouts = made([{"role": "white"}, BLACK])
    truth = length * np.array([0.6, -0.8])
    images = seen(entries, 0.5, 0.7, moved_from=12, shift=truth)
    found = compare(images, *white_to_compare(stills(layouts)), NOISE, 255.0, 2).everywhere
    assert (np.abs(found.pixels - truth) <= SIGMAS * np.sqrt(np.diag(found.covariance))).all()
    # Without a lamp 0.01 px: a third of the limit at most leaves it seen.
    assert found.sigma_px <= 0.06


def test_lit_cells_are_told_from_those_that_the_lamp_lights():
    entries, layouts = made([BLACK, {"role": "white"}], gray_entries(6, 20.0))
    images = seen(entries, 2.0, 0.5)
    cells = [still for still in stills(layouts) if still.lit_only][1]
    white = next(still for still in stills(layouts) if still.blank)
    rows = slice(0, images[0].shape[0])
    means = mean_of(images, cells.images, rows), mean_of(images, white.images, rows)
    counts = comparable(images, cells, white, means, rows, -1.0, 255.0)
    lit = encode(entries[cells.images[0]], np.linspace(100, 700, SIZE_PX[0])) > 0.5
    # Beside the pipe's edges the projector is too dark to tell.
    counted = counts[:, 60:-60].mean(0)
    assert counted[~lit[60:-60]].max() == 0
    assert np.median(counted[lit[60:-60]]) > 0.95


def test_equal_patterns_are_compared_with_each_other_and_white_with_its_neighbours():
    _, layouts = made([{"role": "white"}, BLACK])
    groups = stills(layouts)
    assert [[still.light for still in pair] for pair in to_compare(groups)] == [[0.5, 0.5]]
    first, last = white_to_compare(groups)
    assert (first.images, last.images) == ((8, 9, 10, 11), (12,))
    assert [swing.images for swing in last.exact_swings] == [(12, 13)]


def test_the_noise_of_a_group_under_other_light_is_that_of_its_images():
    rng = np.random.default_rng(5)
    images = rng.standard_normal((2, 100_000))
    white = Still((0,), "white", light=1.0, swings=(Swing.between(0, 1, "none"),))
    light = EqualLight("first", 1.1, -0.4)
    lit = light.gain * images[0] + light.swing * (images[0] - images[1])
    found = light.shares(white, Still((2, 3), "two others"))
    # The standard deviation of a variance from 100,000 values is 0.45 %.
    assert found[0] == pytest.approx(lit.var(), rel=0.03)
    assert found[1] == 0.5


def test_a_movement_that_is_perhaps_too_large_is_warned_of():
    entries, layouts = made([{"role": "white"}, BLACK])
    findings = check(seen(entries, 0.5, 1.0, moved_from=6, shift=(0.0, 0.23), contrast=0.01), layouts)
    assert "may be more than the 0.2 px" in findings[0].warning
    assert findings[1].warning == ""
