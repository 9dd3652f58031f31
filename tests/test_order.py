"""Images that are not what the sequence declares are refused, with the order, sign or period that would fit."""

import numpy as np
import pytest

from planish.errors import InputError
from planish.measurement import NoiseModel
from planish.sensing.capture.sequence import read_layouts
from planish.sensing.checks.order import check_order
from planish.sensing.checks.slips import observe_consistent
from planish.sensing.decode import DecodeOptions
from sequences import PROJECTOR_PX, gray_entries, manifest, phase_entries, render

NOISE = (1.44, 0.025)
MODEL = NoiseModel(1.44 + 1 / 12, 0.025)
POSITIONS = np.broadcast_to(np.linspace(5, 310, 240), (120, 240))
#: Fringes whose whole periods are told apart by longer ones.
PERIODS = (320, 80, 20)


def check(declared, shown, order=None, gamma=1.0, **options):
    """Declare one list of entries, show another one, its images listed in `order`."""
    made, truth = manifest(declared, projector_px=PROJECTOR_PX), manifest(shown, projector_px=PROJECTOR_PX)
    images = render(truth.sequence, POSITIONS, noise=NOISE, **options)
    if gamma != 1.0:
        images = [np.round(255 * (image / 255.0) ** (1 / gamma)).astype(np.uint8) for image in images]
    images = [images[i] for i in order or range(len(images))]
    return check_order(images, read_layouts(made, "c"), MODEL, 255.0, "A", "capture.json")


def decode(declared, shown):
    made, truth = manifest(declared, projector_px=PROJECTOR_PX), manifest(shown, projector_px=PROJECTOR_PX)
    images = {name: render(truth.sequence, POSITIONS, noise=NOISE, seed=k) for k, name in enumerate("AB")}
    layout = read_layouts(made, "c")[0]
    return observe_consistent(images.__getitem__, images.__getitem__, "AB", layout, DecodeOptions(), "capture.json", 2)


@pytest.mark.parametrize("steps", [4, 5, 6, 12])
@pytest.mark.parametrize("wave", ["sine", "square"])
@pytest.mark.parametrize("gamma", [1.0, 2.2])
def test_harmonics_are_not_taken_for_another_order(steps, wave, gamma):
    declared = phase_entries(PERIODS, steps, wave=wave)
    assert [finding.warning for finding in check(declared, declared, gamma=gamma)] == [""]


@pytest.mark.parametrize(
    ("steps", "order", "words"),
    [
        (4, (0, 2, 1, 3), "order 0 2 1 3"),
        (6, (0, 3, 1, 4, 2, 5), "order 0 3 1 4 2 5"),
        (8, (0, 2, 4, 6, 1, 3, 5, 7), "order 0 2 4 6 1 3 5 7"),
        (12, (0, 1, 2, 4, 3, 5, 6, 7, 8, 9, 10, 11), "order 0 1 2 4 3 5 6 7 8 9 10 11"),
        (12, (0, 1, 10, 11, 2, 3, 4, 5, 6, 7, 8, 9), "sorted as text"),
    ],
)
@pytest.mark.parametrize("wave", ["sine", "square"])
def test_another_order_of_the_steps_is_named(steps, order, words, wave):
    declared = phase_entries([320], steps, wave=wave)
    with pytest.raises(InputError, match=words):
        check(declared, declared, order)


def test_a_list_that_begins_with_another_image_is_found():
    declared = [*phase_entries(PERIODS, 4), {"role": "white"}]
    with pytest.raises(InputError, match=r"camera A: the images stand 1 places later in the list than declared"):
        check(declared, [declared[-1], *declared[:-1]])


def test_images_of_something_else_are_refused():
    declared = phase_entries([320], 6)
    noise = manifest([*gray_entries(6, 5.0)])
    images = render(noise.sequence, POSITIONS, noise=NOISE)
    layouts = read_layouts(manifest(declared, projector_px=PROJECTOR_PX), "c")
    with pytest.raises(InputError, match="in no order"):
        check_order(images, layouts, MODEL, 255.0, "A", "capture.json")


def test_without_fringes_the_modulation_is_named():
    declared = phase_entries(PERIODS, 4)
    with pytest.raises(InputError, match=r"no fringes of 20 px; their amplitude is .* is the projector on"):
        check(declared, declared, amplitude=0.0)


def test_saturation_everywhere_is_refused():
    declared = phase_entries(PERIODS, 4)
    with pytest.raises(InputError, match=r"100\.0 % of the pixels are saturated"):
        check(declared, declared, offset=400.0)


@pytest.mark.parametrize(
    ("declared", "shown", "words"),
    [
        (
            phase_entries(PERIODS),
            [*phase_entries(PERIODS[:2]), *phase_entries(PERIODS[2:], sign=-1)],
            "sign -1 for period 20 px",
        ),
        (phase_entries((320, 80, 21)), phase_entries(PERIODS), "a period of 20 instead of 21 px"),
        (phase_entries(PERIODS), phase_entries((320, 20, 80)), "the images of periods 80 and 20 px exchanged"),
        (
            [*phase_entries([20]), *gray_entries(5, 10.0)],
            [*phase_entries([20]), *gray_entries(5, 20.0)],
            "cell_px 20",
        ),
    ],
    ids=["sign", "period", "exchanged", "cells"],
)  # fmt: skip
def test_coarse_against_fine_names_the_sequence_that_fits(declared, shown, words):
    with pytest.raises(InputError, match=words):
        decode(declared, shown)


def test_a_right_sequence_is_decoded():
    seen = decode(phase_entries(PERIODS), phase_entries(PERIODS))
    assert np.isfinite(seen["A"].phases["u"].position_px).mean() > 0.9


def test_one_dark_and_one_saturated_exposure_are_no_reason_to_refuse():
    declared = [{**entry, "exposure_ms": 4.0} for entry in phase_entries(PERIODS, 4)]
    assert check(declared, declared, offset=400.0) == ()
    assert [finding.warning for finding in check(declared, declared, amplitude=0.0)] in ([], [""])
