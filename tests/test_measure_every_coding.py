"""`measure` on simulated captures of every coding: what it finds is right, complete and independent of the order."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from planish.pipeline import measure
from planish.sensing.capture.manifest import Capture
from planish.sensing.patterns.sequences import SEQUENCES, named_sequence, with_exposures
from planish.simulation.render import trace_capture
from planish.simulation.scenes import make_scene
from planish.simulation.writing import write_scene

#: What the issue asks for; a single capture at a third of the resolution leaves sigma's spread more room.
SEEN_SHARE, SPREAD, FAR_SIGMAS, FAR_SHARE = 0.95, (0.75, 1.25), 10, 1e-4
#: Sums over the images in another order change points by less [sigma]; so many pixels may fall on the limit of a mask.
ORDER_SIGMAS, ORDER_SHARE = 0.02, 1e-4
#: A hole takes samples from what is measured over all pixels: noise, gamma, distance of projector and cameras [sigma].
HOLE_SIGMAS, HOLE_SHARE = 0.1, 3e-4
#: Pixels around a hole that edges, islands, a Gray code's lines and the support of a correlation look at.
NEAR_HOLE_PX = 6
SCALE = 0.3
#: A stripe of 12 projector px is 3 camera px there, too few for the interpolation of unit vectors: 8 are needed.
STATISTICAL = {"min_period_px": 36.0}

CODINGS = {
    **{name: (name, STATISTICAL if name == "statistical" else {}) for name in SEQUENCES},
    "multi-frequency, both axes": ("multi-frequency", {"axes": ("u", "v")}),
    "gray-phase, whole cells": ("gray-phase", {"complementary": False, "sign": -1}),
    "gray, no inverses": ("gray", {"inverses": False}),
    "gray, exposures": ("gray", {}),
}


@pytest.fixture(scope="module")
def truth():
    """True points and the pixels that all devices see: the same for all codings."""
    return trace_capture(make_scene("plate", 3, 1, scale=SCALE), 0, "A")


#: test_every_coding asks the same of the positions by every coding.
ALSO_WHOLE = pytest.mark.parametrize("coding", ["heterodyne", "gray", "statistical"], indirect=True)
#: The others take as long again.
QUICK = (*SEQUENCES, "gray, exposures")
PARAMS = [pytest.param(name, marks=() if name in QUICK else pytest.mark.slow) for name in CODINGS]


@pytest.fixture(scope="module", params=PARAMS)
def coding(request, tmp_path_factory):
    name, options = CODINGS[request.param]
    entries = named_sequence(name, **options)
    if "exposures" in request.param:
        entries = with_exposures(entries, [20.0, 15.0])
    scene = replace(make_scene("plate", 3, 1, scale=SCALE), sequence=tuple(entries))
    (folder,) = write_scene(scene, tmp_path_factory.mktemp("coding"), true_points=False)
    return request.param, folder, measure(Capture.load(folder), None, 2)


def other_manifest(folder, change):
    content = json.loads((folder / "capture.json").read_text())
    change(content)
    (folder / "other.json").write_text(json.dumps(content))
    return Capture.load(folder / "other.json")


def moved(m, other, where):
    """Distances [sigma] of the points that both have, and the share of pixels that only one of them has."""
    both = m.valid & other.valid & where
    distance = np.linalg.norm(m.points_sensor[both] - other.points_sensor[both], axis=1)
    return distance / m.sigma_mm[both], ((m.valid != other.valid) & where).sum() / where.sum()


def test_points_are_complete_right_and_honest_about_their_noise(coding, truth):
    name, _, m = coding
    truth, seen = truth
    assert (m.valid & seen).sum() > SEEN_SHARE * seen.sum()
    assert [finding.warning for finding in m.findings if finding.warning] == []
    both = m.valid & np.isfinite(truth[..., 2])
    ray = truth[both] - m.camera.center_sensor
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    z = ((m.points_sensor[both] - truth[both]) * ray).sum(1) / m.sigma_mm[both]
    assert SPREAD[0] < 1.4826 * np.median(np.abs(z - np.median(z))) < SPREAD[1]
    # One period over the whole projector: noise is more than a pixel's step, and a crossing one of several.
    assert (np.abs(z) > FAR_SIGMAS).mean() <= FAR_SHARE * (5 if name == "phase-shift" else 1)


@ALSO_WHOLE
def test_another_order_of_the_manifest_changes_nothing(coding):
    _, folder, m = coding

    def permute(content):
        order = np.random.default_rng(2).permutation(len(content["sequence"]))
        content["sequence"] = [content["sequence"][k] for k in order]
        content["images"] = {c: [files[k] for k in order] for c, files in content["images"].items()}

    again = measure(other_manifest(folder, permute), None, 2)
    distance, lost = moved(m, again, np.ones(m.shape, bool))
    assert lost <= ORDER_SHARE
    assert distance.max() < ORDER_SIGMAS


@ALSO_WHOLE
def test_a_dark_hole_spreads_no_further_than_its_rim(coding, tmp_path):
    name, folder, m = coding
    for path in folder.glob("[AB]_*.png"):
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        if path.name.startswith("A"):
            image[120:140, 180:210] = 5
        cv2.imwrite(str(tmp_path / path.name), image)
    again = measure(Capture.load(folder / "capture.json", tmp_path), None, 2)
    assert not again.valid[122:138, 182:208].any()
    far = np.ones(m.shape, bool)
    far[120 - NEAR_HOLE_PX : 140 + NEAR_HOLE_PX, 180 - NEAR_HOLE_PX : 210 + NEAR_HOLE_PX] = False
    distance, lost = moved(m, again, far)
    assert lost < HOLE_SHARE
    # Beside the noise of one period a crossing is one of several: which one, may change.
    assert np.quantile(distance, 0.999 if name == "phase-shift" else 1) < HOLE_SIGMAS
