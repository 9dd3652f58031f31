"""The dense path: weak textures are found by correlation of whole surfaces, and unrelated ones are not."""

from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree

import sheets
import synthetic
from given_surface import GivenSurface
from planish.geometry import compose, exp_so3, invert, transform_points
from planish.registration.consensus import Search, find_consensus
from planish.registration.dense.develop import Development
from planish.registration.dense.match import DenseOptions, DenseTexture, match_windows
from planish.registration.dense.spectrum import analyse, plan_rotations
from planish.registration.options import PairOptions
from planish.registration.pair import keypoints_may_fail, register_pair
from planish.registration.prepared import prepare
from planish.registration.texture.resample import TextureImage
from planish.registration.verdict.false_alarms import log10_false_alarms
from planish.registration.verdict.judge import judge_coarse

PITCH = 1.0
SIZE = (230, 260)
#: Rms error of the found transform over the overlap [mm]: from there the refinement takes over.
POSITION_TOLERANCE = 1.0


def texture(seed, along=1.2, across=1.2, size=(900, 900)):
    """Smooth noise of unit variance with the given correlation lengths [px]."""
    noise = np.random.default_rng(seed).standard_normal(size).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), along, sigmaY=across)
    return smooth / smooth.std()


def view(part, angle, centre, contrast, seed, pattern=0.0, cylinder_mm=None):
    """The part seen turned by `angle` about `centre` with unit noise, and its T_part_view (planes only)."""
    h, w = SIZE
    c, s = np.cos(angle), np.sin(angle)
    R = np.array([[c, -s], [s, c]])
    shift = np.asarray(centre, float) - R @ [w / 2, h / 2]
    image = cv2.warpAffine(part, np.column_stack([R, shift]), (w, h), flags=cv2.INTER_CUBIC + cv2.WARP_INVERSE_MAP)
    rng = np.random.default_rng(seed)
    value = contrast * image + rng.standard_normal(SIZE).astype(np.float32)
    value += pattern * np.random.default_rng(99).standard_normal(SIZE).astype(np.float32)
    v, u = np.indices(SIZE, dtype=np.float32)
    source = np.dstack([u, v])
    noise = np.random.default_rng(1).standard_normal(SIZE).astype(np.float32)
    s_mm, t_mm = u * PITCH, v * PITCH
    if cylinder_mm is None:
        points, normals, x_axis = np.dstack([s_mm, t_mm, 0 * s_mm]), [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]
    else:
        # In the part's coordinates, so that all views lie on one cylinder about the y axis.
        x, y = (np.dstack([u, v]) @ R.T + shift).transpose(2, 0, 1) * PITCH
        sine, cosine = np.sin(x / cylinder_mm), np.cos(x / cylinder_mm)
        points = np.dstack([cylinder_mm * sine, y, cylinder_mm * (1 - cosine)])
        normals = np.dstack([sine, 0 * x, -cosine])
        x_axis = c * np.dstack([cosine, 0 * x, sine]) + s * np.array([0.0, 1.0, 0.0])
    points, normals, x_axis = (np.broadcast_to(m, (*SIZE, 3)).astype(np.float32) for m in (points, normals, x_axis))
    everywhere = np.ones(SIZE, bool)
    surface = GivenSurface(points, normals, x_axis)
    picture = TextureImage(PITCH, value, np.ones_like(value), everywhere, source, surface)
    T = np.eye(4)
    T[:2, :2], T[:2, 3] = R, shift * PITCH
    development = Development(picture, 1, value, noise, everywhere, source)
    return DenseTexture(development, analyse(development)), T


def moved(texture, T):
    """The same piece of surface as another sensor frame has it."""
    picture, turn = texture.development.image, np.float32(T[:3, :3].T)
    points = np.asarray(transform_points(T, picture.surface.points_sensor), np.float32)
    normals, x_axis = picture.surface.normals_sensor @ turn, picture.surface.x_axis_sensor @ turn
    picture = replace(picture, surface=GivenSurface(points, normals, x_axis))
    return replace(texture, development=replace(texture.development, image=picture))


def found(a, b):
    windows = match_windows((a,), (b,), 1.0, threads=1)
    coarse = find_consensus(windows.matches, threads=1, search=Search(np.inf, windows.chance, windows.tried))
    best = coarse.candidates[0] if coarse.candidates else None
    alarms = log10_false_alarms(best.places if best else 0, coarse.places, coarse.chance, windows.tried)
    return best, alarms


def error_mm(T, T_true, a, b):
    """Rms error over those points of b that truly lie on a."""
    p = b.development.image.surface.points_sensor.reshape(-1, 3)[::97].astype(float)
    true = transform_points(T_true, p)
    common = cKDTree(a.development.image.surface.points_sensor.reshape(-1, 3)).query(true)[0] < PITCH
    return float(np.sqrt(((transform_points(T, p) - true) ** 2).sum(1)[common].mean()))


#: Texture of this share of the noise's standard deviation cannot be seen in any single place.
WEAK = 0.35


@pytest.mark.parametrize("turned_deg", [37.0, 217.0])
def test_a_weak_brushed_texture_is_found_in_either_direction(turned_deg):
    part = texture(3, along=3.0, across=0.9)
    a, T_part_a = view(part, 0.2, (400, 400), WEAK, 10)
    b, T_part_b = view(part, 0.2 + np.deg2rad(turned_deg), (440, 360), WEAK, 11)
    best, alarms = found(a, b)
    assert alarms < -10
    assert error_mm(best.T_a_b, invert(T_part_a) @ T_part_b, a, b) < POSITION_TOLERANCE


@pytest.mark.slow
def test_a_weak_texture_without_direction_is_found_at_any_rotation():
    part = texture(4)
    a, T_part_a = view(part, 0.0, (400, 400), WEAK, 12)
    b, T_part_b = view(part, 2.1, (430, 420), WEAK, 13)
    assert not a.spectrum.directional
    best, alarms = found(a, b)
    assert alarms < -10
    assert error_mm(best.T_a_b, invert(T_part_a) @ T_part_b, a, b) < POSITION_TOLERANCE


def test_windows_carry_the_curvature_into_the_transform():
    part = texture(5, along=3.0, across=0.9)
    a, _ = view(part, 0.1, (400, 400), WEAK, 14, cylinder_mm=150.0)
    b, _ = view(part, 0.9, (430, 380), WEAK, 15, cylinder_mm=150.0)
    T_sensor = compose(exp_so3([0.3, -0.2, 0.5]), [10.0, 20.0, 30.0])
    b = moved(b, T_sensor)
    best, alarms = found(a, b)
    assert alarms < -10
    assert error_mm(best.T_a_b, invert(T_sensor), a, b) < POSITION_TOLERANCE


@pytest.mark.parametrize("seed", range(4))
def test_unrelated_textures_of_one_kind_give_no_significant_consensus(seed):
    a, _ = view(texture(20 + seed, along=3.0, across=0.9), 0.2, (400, 400), WEAK, 30 + seed)
    b, _ = view(texture(40 + seed, along=3.0, across=0.9), 0.7, (400, 400), WEAK, 50 + seed)
    assert found(a, b)[1] > 0


def test_what_stands_still_in_the_image_is_not_taken_for_texture():
    a, _ = view(texture(6, along=3.0, across=0.9), 0.3, (300, 300), WEAK, 16, pattern=0.7)
    b, _ = view(texture(7, along=3.0, across=0.9), 0.3, (600, 600), WEAK, 17, pattern=0.7)
    assert found(a, b)[1] > 0


def test_the_result_is_the_same_for_any_number_of_threads():
    part = texture(8, along=3.0, across=0.9)
    a, _ = view(part, 0.2, (400, 400), WEAK, 18)
    b, _ = view(part, 0.6, (430, 390), WEAK, 19)
    one, three = (match_windows((a,), (b,), 1.0, threads=n).matches for n in (1, 3))
    assert one.points_a.tobytes() == three.points_a.tobytes()
    assert one.points_b.tobytes() == three.points_b.tobytes()


def test_no_texture_gives_no_matches():
    assert len(match_windows((), (), 1.0).matches) == 0


def test_rotations_to_be_tried_are_few_for_a_brushed_texture_and_contain_the_true_one():
    part = texture(9, along=3.0, across=0.9)
    a, _ = view(part, 0.2, (400, 400), WEAK, 20)
    b, _ = view(part, 1.1, (420, 400), WEAK, 21)
    plan = plan_rotations(a.spectrum, b.spectrum, 2e4)
    step = 2 * np.pi / plan.full_turn
    assert len(plan.angles) < 0.15 * plan.full_turn
    assert np.abs(np.angle(np.exp(1j * (plan.angles - 0.9)))).min() < step


def test_a_seam_across_the_image_does_not_give_the_direction():
    a, _ = view(texture(10, along=3.0, across=0.9), 0.2, (400, 400), WEAK, 22)
    value = a.development.value.copy()
    value[:, 100:102] += 4.0
    seamed = analyse(replace(a.development, value=value))
    plan = plan_rotations(a.spectrum, seamed, 2e4)
    turned = np.abs(np.angle(np.exp(2j * plan.angles))) / 2
    assert turned.max() < np.deg2rad(10.0)


@pytest.mark.parametrize(
    ("signal_to_noise", "directed", "asked"),
    [(3.9, False, True), (3.9, True, True), (6.0, False, False), (6.0, True, True), (9.1, True, False)],
)
def test_whole_textures_are_asked_where_keypoints_may_fail(signal_to_noise, directed, asked):
    texture = SimpleNamespace(spectrum=SimpleNamespace(directional=directed))
    strong, side = (SimpleNamespace(signal_to_noise=s, dense=(texture,)) for s in (100.0, signal_to_noise))
    assert keypoints_may_fail(strong, side, DenseOptions()) == keypoints_may_fail(side, strong, DenseOptions()) == asked


@pytest.fixture(scope="module")
def strangers():
    """Two sheets with weak textures that have nothing to do with each other."""
    return tuple(
        prepare(
            synthetic.measurement(T, sheets.grain(0.002, seed), name=name, scale=sheets.SCALE, seed=seed),
            sheets.PITCH_MM,
        )
        for seed, (name, T) in enumerate((("a", np.eye(4)), ("b", sheets.T_TRUE)), start=60)
    )  # fmt: skip


def test_a_pair_that_is_tried_twice_has_twice_the_false_alarms(strangers, monkeypatch):
    judged = []

    def watched(*arguments):
        judged.append(judge_coarse(*arguments))
        asked.append(arguments[4])
        return judged[-1]

    asked = []
    monkeypatch.setattr("planish.registration.pair.judge_coarse", watched)
    result = register_pair(*strangers, pairs_in_run=10)
    assert asked == [10, 20]
    assert result.status == "refused"
    first, second = (verdict.log10_false_alarms for verdict in judged)
    assert result.log10_false_alarms == pytest.approx(min(first + np.log10(2), second))
    assert ("second try" in result.reason) == (first + np.log10(2) <= second)
    once = PairOptions(dense=DenseOptions(enabled=False))
    assert register_pair(*strangers, once, 10).log10_false_alarms == pytest.approx(first)
