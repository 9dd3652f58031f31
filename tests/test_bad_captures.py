"""Captures that are not what they say, through `planish measure`: refused with words, warned of, or measured right."""

import json
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest

from command_line import planish
from planish.measurement import Measurement
from planish.rig import Rig
from planish.sensing.patterns.sequences import named_sequence, with_exposures
from planish.simulation.render import trace_capture
from planish.simulation.scenes import make_scene
from planish.simulation.sensor import reference_rig
from planish.simulation.writing import write_scene

SCALE, LARGER = 0.35, 0.4
#: Points of other bits differ by rounding alone [sigma]; right points have errors of this median [sigma].
ROUNDED_SIGMAS, RIGHT_SIGMAS = 0.05, (0.5, 0.9)
STATISTICAL = {"min_period_px": 30.0}


@pytest.fixture(scope="module")
def captures(tmp_path_factory):
    """Writes each coding's capture when it is first asked for."""
    written = {}

    def get(name):
        if name not in written:
            entries = named_sequence(name, **(STATISTICAL if name == "statistical" else {}))
            scene = replace(make_scene("plate", 3, 1, scale=SCALE), sequence=tuple(entries))
            (written[name],) = write_scene(scene, tmp_path_factory.mktemp(name), true_points=False)
        return written[name]

    return get


@pytest.fixture(scope="module")
def truth():
    return trace_capture(make_scene("plate", 3, 1, scale=SCALE), 0, "A")[0]


@pytest.fixture
def capture(captures, tmp_path):
    return lambda name: shutil.copytree(captures(name), tmp_path / "m1")


def run(folder):
    outcome = planish("measure", folder, "--out", folder.parent / "out")
    return outcome, " ".join(outcome.err.split())


def edit(folder, change):
    content = json.loads((folder / "capture.json").read_text())
    change(content)
    (folder / "capture.json").write_text(json.dumps(content))


def repaint(folder, paint, cameras="AB"):
    for path in [p for c in cameras for p in sorted(folder.glob(f"{c}_*.png"))]:
        cv2.imwrite(str(path), paint(cv2.imread(str(path), cv2.IMREAD_UNCHANGED)))


def exchange(*pairs, cameras="AB"):
    def change(content):
        for name in cameras:
            files = content["images"][name]
            for i, j in pairs:
                files[i], files[j] = files[j], files[i]

    return lambda folder: edit(folder, change)


def without(*entries):
    def change(content):
        for files in (content["sequence"], content["images"]["A"], content["images"]["B"]):
            files[:] = [item for k, item in enumerate(files) if k not in entries]

    return lambda folder: edit(folder, change)


def sign_of(first, last):
    return lambda folder: edit(folder, lambda c: [e.update(sign=-1) for e in c["sequence"][first:last]])


def swap_cameras(folder):
    edit(folder, lambda c: c.update(images={"A": c["images"]["B"], "B": c["images"]["A"]}))


def without_projector(folder):
    rig = Rig.load(folder / "rig.json")
    replace(rig, projector=None).save(folder / "rig.json")


def one_camera(folder):
    edit(folder, lambda c: c["images"].pop("B"))


def both(*changes):
    return lambda folder: [change(folder) for change in changes]


def colours(folder):
    repaint(folder, lambda image: cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))


def larger_rig(folder):
    reference_rig(LARGER).save(folder / "rig.json")


def exposures(folder):
    entries = named_sequence("statistical", **STATISTICAL)
    twice = [e.model_dump(exclude_none=True) for e in with_exposures(entries, [20.0, 5.0])]
    edit(folder, lambda c: c.update(sequence=twice, images={k: 2 * files for k, files in c["images"].items()}))


@pytest.mark.parametrize(
    ("coding", "damage", "words"),
    [
        ("reference", without(9), ["capture.json", "period 20 px has steps [0, 2, 3] of 4", "each step 0 ... 3 once"]),
        ("gray-phase", without(6), ["capture.json", "Gray bits [0, 1, 2, 3, 5, 6]", "each bit 0 ... 6 once"]),
        ("gray", without(4), ["capture.json", "each bit 0 ... 10 once"]),
        ("reference", exchange((9, 10)), ["capture.json: camera A", "period 20 px fit the order 0 2 1 3"]),
        ("reference", exchange((1, 2), cameras="B"), ["camera B", "period 1280 px fit the order 0 2 1 3"]),
        ("phase-shift", exchange((2, 3)), ["fit the order 0 1 3 2 4 5 6 7"]),
        ("heterodyne", exchange((0, 4), (1, 5), (2, 6), (3, 7)), ["images of periods", "exchanged (axis u)"]),
        ("gray-phase", exchange((9, 10)), ["coarse and fine patterns contradict each other"]),
        ("reference", sign_of(8, 12), ["expected sign 1 for period 20 px"]),
        ("heterodyne", sign_of(0, 4), ["expected sign 1 for period 35.6757 px"]),
        ("gray-phase", sign_of(0, 4), ["expected sign 1 for all periods"]),
        ("square", sign_of(0, 6), ["expected sign 1 for all periods"]),
        ("gray-phase", both(without_projector, sign_of(0, 4)), ["expected sign 1 for all periods"]),
        ("reference", swap_cameras, ["capture.json: the images of A and B are exchanged"]),
        ("gray", both(without_projector, swap_cameras), ["the images of A and B are exchanged"]),
        ("statistical", swap_cameras, ["the images of A and B are exchanged"]),
        ("statistical", exposures, ["exposures: several"]),
        ("statistical", one_camera, ["capture.json", "seen by one camera; expected images of two cameras"]),
        ("reference", both(one_camera, without_projector), ["expected images and calibration of A and B, or of the"]),
        ("reference", colours, ["A_00", "3 channels", "expected a grey image"]),
        ("reference", larger_rig, ["A_00", "is 486 x 363 px; expected 555 x 415 px, as camera A of the rig"]),
    ],
)  # fmt: skip
def test_what_cannot_be_measured_is_refused_with_words(capture, coding, damage, words):
    folder = capture(coding)
    damage(folder)
    outcome, message = run(folder)
    assert outcome.code == 2
    for part in words:
        assert part in message
    assert outcome.out == ""
    assert not list(folder.parent.glob("out/*"))


@pytest.mark.parametrize("coding", ["heterodyne", "gray-phase", "gray", "square", "statistical"])
@pytest.mark.parametrize(
    ("paint", "cameras", "words"),
    [
        (lambda image: 60 + image % 5, "AB", ["no fringes of", "no Gray bit reaches", "dark"]),
        (lambda image: np.full_like(image, 255), "B", ["are saturated", "no Gray bit reaches", "unmatched"]),
    ],
    ids=["no modulation", "saturated"],
)
def test_images_without_patterns_are_refused_whatever_the_coding(capture, coding, paint, cameras, words):
    folder = capture(coding)
    repaint(folder, paint, cameras)
    outcome, message = run(folder)
    assert outcome.code == 2
    assert any(part in message for part in words)


@pytest.mark.parametrize("coding", ["reference", "statistical"])
def test_twelve_bits_in_sixteen_are_measured_wherever_they_stand(captures, capture, coding, tmp_path):
    folder = capture(coding)
    assert run(folder)[0].code == 0
    expected = Measurement.load(tmp_path / "out" / "m1.h5")
    for shift in (1, 16):
        # First 8 bits become 12 at the low end; the second time they move to the high end.
        repaint(folder, lambda image, low=(shift == 1): 16 * image.astype(np.uint16) + (7 if low else 0))
        outcome, message = run(folder)
        assert (outcome.code, message) == (0, "")
        m = Measurement.load(tmp_path / "out" / "m1.h5")
        assert (m.valid != expected.valid).mean() < 1e-3
        both_have = m.valid & expected.valid
        distance = np.linalg.norm(m.points_sensor - expected.points_sensor, axis=-1)[both_have]
        assert np.quantile(distance / expected.sigma_mm[both_have], 0.999) < ROUNDED_SIGMAS
        assert np.median(m.sigma_mm[both_have] / expected.sigma_mm[both_have]) == pytest.approx(1, abs=0.02)


@pytest.mark.parametrize(
    ("coding", "damage", "warning"),
    [
        ("statistical", exchange((3, 4), cameras="A"), "of the lit pixels became points"),
        ("gray-phase", exchange((4, 5)), "camera and projector contradict each other"),
        ("gray", exchange((4, 5)), "camera and projector contradict each other"),
        ("phase-shift", sign_of(0, 8), "camera and projector contradict each other"),
    ],
    ids=["two images exchanged in one camera", "two bits exchanged", "a bit and its inverse exchanged", "sign of all"],
)
def test_what_two_cameras_can_do_without_is_right_and_warned_of(capture, truth, coding, damage, warning):
    folder = capture(coding)
    damage(folder)
    outcome, message = run(folder)
    assert outcome.code == 0
    assert warning in message
    m = Measurement.load(folder.parent / "out" / "m1.h5")
    known = m.valid & np.isfinite(truth[..., 2])
    error = np.linalg.norm(m.points_sensor[known] - truth[known], axis=1) / m.sigma_mm[known]
    assert RIGHT_SIGMAS[0] < np.median(error) < RIGHT_SIGMAS[1]
    assert (error > 10).mean() < 1e-3
