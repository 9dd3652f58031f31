"""What holds for every coding: decoding undoes encoding, light and order do not matter, gaps stay where they are."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from planish.measurement import REJECTIONS, NoiseModel
from planish.sensing.capture.sequence import read_layouts
from planish.sensing.decode import DecodeOptions
from planish.sensing.observe import observe
from planish.sensing.patterns.sequences import SEQUENCES, named_sequence, statistical_sequence
from planish.sensing.points.correlate import CorrelateOptions, correlate
from sequences import blurred, manifest, plane_points, render, small_rig

#: Half a level of 65,536 in every step, amplitude 80 of 256, as a share of the longest period; single precision [px].
ROUNDING, SINGLE_PX = 1e-5, 3e-4
#: Two edges of a Gray code, blurred by the lens (as in test_gray_edges); other light rounds them otherwise [px].
EDGES_PX, ROUNDED_EDGES_PX = 0.06, 2e-3
#: What interpolation between the pixels leaves of statistical patterns (twice that of test_correlate: any seed) [px].
INTERPOLATION_PX = 2e-2
SHAPE = (20, 200)
#: Noise is measured in all pixels: what a hole takes away changes the weights of averaged periods a little [sigma].
WITHOUT_HOLE_SIGMAS = 0.06
#: Pixels around it that the repair of slips, the search for inter-reflection and edges look at [px].
NEAR_HOLE_PX = 4

SIGNS = st.sampled_from([1, -1])
OPTIONS = {
    "reference": {},
    "phase-shift": {"steps": st.integers(3, 16), "sign": SIGNS},
    "multi-frequency": {
        "period_px": st.floats(8, 60), "steps": st.integers(3, 9), "ratio": st.floats(3, 10), "sign": SIGNS,
    },
    "heterodyne": {"count": st.sampled_from([2, 3]), "steps": st.integers(3, 9), "sign": SIGNS},
    # A projector shows borders of cells at whole pixels: alone, without a complementary bit, they must be periods' too.
    "gray-phase": {
        "period_px": st.integers(12, 60).map(float), "steps": st.integers(3, 9), "complementary": st.booleans(),
        "inverses": st.booleans(), "sign": SIGNS,
    },
    "gray": {"cell_px": st.sampled_from([1.0, 2.0, 3.0, 8.0]), "inverses": st.booleans()},
    "square": {"period_px": st.sampled_from([12.0, 18.0, 24.0]), "steps": st.sampled_from([4, 6, 8, 12]),
               "inverses": st.booleans(), "sign": SIGNS},
}  # fmt: skip
POSITIONAL = sorted(OPTIONS)


def options_of(name):
    return st.fixed_dictionaries({key: value if hasattr(value, "map") else st.just(value)
                                  for key, value in OPTIONS[name].items()})  # fmt: skip


def ramp(seed, extent):
    """Positions (H, W) of a tilted plane inside the projector, rising or falling by 0.6 to 1 px per pixel."""
    rng = np.random.default_rng(seed)
    slope = rng.uniform(0.6, 1.0)
    start = rng.uniform(4, extent - 8 - slope * SHAPE[1])
    rise = start + slope * np.arange(SHAPE[1]) + np.linspace(0, rng.uniform(0, 2), SHAPE[0])[:, None]
    return rise if rng.random() < 0.5 else rise[:, ::-1].copy()


def shown(plan, positions, **light):
    """16-bit images; a Gray code that stands alone is seen through a lens."""
    alone = not any(entry.role == "phase" for entry in plan.sequence)
    return (blurred if alone else render)(plan.sequence, positions, bits=16, **light)


def seen(plan, images):
    (layout,) = read_layouts(plan, "test")
    found = observe({"A": images}.__getitem__, ("A",), layout, DecodeOptions(), "test", 2)["A"]
    (phase,) = found.phases.values()
    return phase


def plan_of(name, axis="u", extent=1280, **options):
    size = (extent, 800) if axis == "u" else (800, extent)
    entries = [e.model_dump() for e in named_sequence(name, size, axes=(axis,), **options)]
    return manifest(entries, projector_px=size)


def tolerance(plan):
    """Largest error of a position that rounding, lens or the steps of a square wave allow [px]."""
    phases = [entry for entry in plan.sequence if entry.role == "phase"]
    if not phases:
        return EDGES_PX
    finest = min(phases, key=lambda entry: entry.period_px)
    # The phase of a square wave in N steps is a staircase of N steps (2 N where N is odd).
    stairs = finest.period_px / finest.steps / 2 if finest.wave == "square" else 0.0
    return stairs + SINGLE_PX + ROUNDING * 30 * finest.period_px


def inner(plan):
    """Columns whose neighbours are seen too: a cell of a Gray code has an edge on both sides, 0.6 px per pixel."""
    alone = not any(entry.role == "phase" for entry in plan.sequence)
    margin = 2 + int(np.ceil(plan.sequence[0].cell_px / 0.6)) if alone else 0
    return slice(margin, SHAPE[1] - margin)


def test_every_sequence_is_tried_here():
    assert {*OPTIONS, "statistical"} == set(SEQUENCES)


@pytest.mark.parametrize("name", POSITIONAL)
@settings(max_examples=6)
@given(data=st.data())
def test_decoding_undoes_encoding_with_any_options(name, data):
    axis, seed = data.draw(st.sampled_from("uv")), data.draw(st.integers(0, 1000))
    extent = 1280 if name == "reference" else data.draw(st.integers(400, 2000))
    assume(name != "reference" or axis == "u")
    plan = plan_of(name, axis, extent, **data.draw(options_of(name)))
    positions = ramp(seed, extent)
    found = seen(plan, shown(plan, positions))
    columns = inner(plan)
    assert np.isfinite(found.position_px[:, columns]).mean() > 0.99
    assert np.nanmax(np.abs(found.position_px - positions)[:, columns]) < tolerance(plan)


@pytest.mark.parametrize("name", POSITIONAL)
@settings(max_examples=3)
@given(gain=st.floats(0.3, 1.1), offset=st.floats(2.0, 60.0), seed=st.integers(0, 1000))
def test_brightness_and_offset_change_nothing_beyond_rounding(name, gain, offset, seed):
    plan, positions = plan_of(name), ramp(seed, 1280)
    found = [
        seen(plan, shown(plan, positions, amplitude=a, offset=o)).position_px
        for a, o in ((160.0, 40.0), (160.0 * gain, offset))
    ]
    limit = ROUNDED_EDGES_PX if name == "gray" else SINGLE_PX + ROUNDING / gain * 1320
    assert np.array_equal(*(np.isfinite(x) for x in found))
    assert np.nanmax(np.abs(found[0] - found[1])) < limit


@pytest.mark.parametrize("name", POSITIONAL)
def test_the_declared_order_of_the_images_changes_nothing(name):
    plan, positions = plan_of(name), ramp(5, 1280)
    images = shown(plan, positions, noise=NoiseModel(1.0, 0.02) if name == "gray" else (1.0, 0.02))
    order = np.random.default_rng(1).permutation(len(images))
    permuted = manifest([plan.sequence[i].model_dump() for i in order], projector_px=(1280, 800))
    found, again = seen(plan, images), seen(permuted, [images[i] for i in order])
    assert np.array_equal(found.rejected, again.rejected)
    # Sums in another order.
    assert np.nanmax(np.abs(found.position_px - again.position_px)) <= SINGLE_PX
    assert np.nanmax(np.abs(found.sigma_px / again.sigma_px - 1)) < 1e-3


@pytest.mark.parametrize("name", POSITIONAL)
def test_a_dark_hole_changes_nothing_beside_its_rim(name):
    plan, positions = plan_of(name), ramp(5, 1280)
    images = shown(plan, positions, noise=NoiseModel(1.0, 0.02) if name == "gray" else (1.0, 0.02))
    holed = [image.copy() for image in images]
    for image in holed:
        image[8:12, 90:100] = 20 * 256
    found, again = seen(plan, images), seen(plan, holed)
    assert (again.rejected[8:12, 90:100] != 0).all()
    far = np.ones(SHAPE, bool)
    far[8 - NEAR_HOLE_PX : 12 + NEAR_HOLE_PX, 90 - NEAR_HOLE_PX : 100 + NEAR_HOLE_PX] = False
    assert np.array_equal(found.rejected[far], again.rejected[far])
    change = np.abs(found.position_px - again.position_px) / found.sigma_px
    assert np.nanmax(change[far]) < WITHOUT_HOLE_SIGMAS


@settings(max_examples=3)
@given(
    tilt=st.tuples(st.floats(-0.2, 0.2), st.floats(-0.2, 0.2)), count=st.integers(12, 24), seed=st.integers(1, 100),
    own=st.sampled_from("AB"),
)  # fmt: skip
def test_statistical_patterns_of_any_seed_give_the_corresponding_pixels(tilt, count, seed, own):
    rig, silent = small_rig(), NoiseModel(1 / 12, 0.0)
    entries = statistical_sequence(rig.projector.size_px, count=count, min_period_px=24.0, seed=seed)[:-2]
    images = {
        name: render(entries, rig.projector.project(plane_points(camera, tilt))[..., 0], bits=16)
        for name, camera in rig.cameras.items()
    }
    other = rig.other(own)
    pairs, rejected = correlate(
        images[own], images[other], rig.cameras[own], rig.cameras[other], silent, silent, (65535.0, 65535.0),
        CorrelateOptions(), 2,
    )  # fmt: skip
    truth = rig.cameras[other].project(plane_points(rig.cameras[own], tilt))
    inside = (truth >= 3).all(-1) & (truth <= np.array(rig.cameras[other].size_px) - 4).all(-1)
    ambiguous = (rejected >> REJECTIONS.index("ambiguous")) & 1 == 1
    assert (rejected[inside & ~ambiguous] == 0).mean() > 0.99
    assert np.nanmax(np.abs(pairs.pixel_px - truth)[inside & (rejected == 0)]) < INTERPOLATION_PX
