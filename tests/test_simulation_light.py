"""Exposures, both axes, projector gamma, statistical patterns and highlights of the simulator."""

from dataclasses import replace

import numpy as np
import pytest

from planish.errors import InputError
from planish.sensing.patterns.entries import Black, Statistical, White
from planish.sensing.patterns.sequences import encode, phase_steps, with_exposures
from planish.simulation.highlights import with_highlights
from planish.simulation.light import Light
from planish.simulation.render import render_capture, trace_capture
from planish.simulation.scenes import make_scene
from planish.simulation.sensor import reference_rig

SCALE = 0.15
#: 16-bit images are rounded to 1/257 of a grey level.
ROUNDING = 0.5 / 257
BLACK_LEVEL = 0.02 * 255
#: A camera pixel is 7 projector px wide here, its lens blurs by 4: that takes 0.3 % from the amplitude of a fringe,
#: and of the second harmonic that a gamma adds four times as much.
PERIOD_PX, BLUR = 400.0, 0.006


def plain(sequence, **changes):
    """A matt plate without texture, noise or dust, in 16 bit; grey levels (N, H, W) of camera A."""
    scene = make_scene("blank", 3, 1, scale=SCALE)
    still = {"noise_factor": 0.0, "prnu": 0.0, "dust": 0, "projector_dust": 0, "vignetting": 0.0, "grid_depth": 0.0}
    sensor = replace(scene.sensor, bits=16, **{**still, **changes})
    return replace(
        scene, sensor=sensor, light=Light(specular=0, ambient=0), sequence=tuple(sequence), rig=reference_rig(SCALE)
    )  # fmt: skip


def levels(scene):
    return render_capture(scene, 0)["A"] / 257.0 - BLACK_LEVEL


def test_an_entry_is_as_bright_as_its_exposure_is_long():
    white = [White(role="white")]
    images = levels(plain([*with_exposures(white, [5.0, 20.0, 5.0 / 3])]))
    lit = images[1] > 20
    assert np.abs(images[0] - images[1] / 4)[lit].max() < 2 * ROUNDING
    assert np.abs(images[2] - images[1] / 12)[lit].max() < 2 * ROUNDING
    assert np.array_equal(images[1], levels(plain(white))[0])


def test_the_noise_of_each_exposure_is_its_own():
    entries = with_exposures([White(role="white")], [10.0, 20.0])
    scene = plain(entries, noise_factor=1.0)
    first, second = levels(scene) - levels(plain(entries))
    lit = levels(plain(entries))[0] > 20
    assert abs(np.corrcoef(first[lit], second[lit])[0, 1]) < 0.05


@pytest.mark.parametrize("axis", ["u", "v"])
def test_fringes_along_either_axis_lie_where_the_projector_puts_them(axis):
    scene = plain([*phase_steps(PERIOD_PX, 4, axis), White(role="white")])
    images = levels(scene)
    points, seen = trace_capture(scene, 0, "A")
    u = scene.rig.projector.project(points[seen])[:, 0 if axis == "u" else 1]
    for k, entry in enumerate(scene.sequence[:4]):
        assert np.abs(images[k][seen] / images[4][seen] - encode(entry, u)).max() < BLUR


def test_a_statistical_pattern_is_the_profile_of_its_index():
    entry = Statistical(role="statistical", index=3, seed=7, min_period_px=PERIOD_PX)
    scene = plain([entry, White(role="white")])
    images = levels(scene)
    points, seen = trace_capture(scene, 0, "A")
    u = scene.rig.projector.project(points[seen])[:, 0]
    assert np.abs(images[0][seen] / images[1][seen] - encode(entry, u)).max() < BLUR


def test_the_gamma_of_the_projector_bends_the_pattern_and_leaves_white_and_black():
    entries = [*phase_steps(PERIOD_PX, 4), White(role="white"), Black(role="black")]
    straight, bent = (levels(plain(entries, projector_gamma=g)) for g in (1.0, 2.2))
    assert np.array_equal(straight[4:], bent[4:])
    lit = straight[4] > 20
    expected = (straight[:4] / straight[4])[:, lit] ** 2.2
    assert np.abs((bent[:4] / bent[4])[:, lit] - expected).max() < BLUR


@pytest.mark.parametrize("scene", ["plate", "door"])
def test_highlights_saturate_the_share_that_is_asked_for(scene):
    shining = with_highlights(make_scene(scene, 1, 1, scale=0.25), 0.05)
    white = render_capture(replace(shining, sequence=(White(role="white"),)), 0)["A"][0]
    lit = white > 38
    # Found on coarser pixels.
    assert (white[lit] == 255).mean() == pytest.approx(0.05, abs=0.01)


@pytest.mark.parametrize("share", [0.0, 0.7, float("nan")])
def test_a_share_of_highlights_out_of_range_is_refused(share):
    with pytest.raises(InputError, match="highlights"):
        with_highlights(make_scene("plate", 1, 1, scale=0.25), share)
