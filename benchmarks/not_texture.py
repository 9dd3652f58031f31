"""What is no texture of the part must not register it: sensor pattern, dust, background, repeating prints, boards.

    python benchmarks/not_texture.py
    python benchmarks/not_texture.py --tables

- blank: plates without any texture, pixel response 0.5 %, 10 dust spots per camera, moved by at least 50 mm
- background: a static textured plane on about 30 % of the pixels, behind a textured plate and behind a blank one
- print: a random pattern that repeats every 40 mm on a blank plate; overlaps of 30 to 70 %
- pattern: simulated chessboards and rasters of dots of 5, 20 and 40 mm on a blank plate, everywhere or with their ends
  in view
- board: three real views of a chessboard (shared/data/procam_board), whose corners say how it moved; by the calibration
  that its author gives, which contradicts itself by some pixels, and by planish's of the same board
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import combinations

import cv2
import numpy as np

from coarse import error_mm
from coarse_pairs.parts import HALF_SAMPLES
from coarse_pairs.tables import RIGHT_MM
from planish.geometry import Array, fit_rigid, invert, transform_points
from planish.measurement import Measurement
from planish.pipeline import measure, prepare_run
from planish.registration.pair import register_pair
from planish.rig import Rig
from planish.sensing.calibrate.boards.observe import observe_boards
from planish.sensing.calibrate.calibrate import CalibrateOptions, calibrate
from planish.sensing.capture.manifest import Capture
from planish.simulation.printed import raster_print
from planish.simulation.scenes import Background, Scene, make_scene, place_sensor
from planish.simulation.surfaces import Plate
from planish.simulation.texture import BLANK
from render_tables import ROOT, save_table
from shared.cells import Rows, cell_arguments, machines, read_rows, run_cells
from shared.patterns import Pattern, pattern_print
from shared.rendered import measure_scene

FOLDER = "not-texture"
#: Captures per cell: 11 make 55 pairs.
BLANK_CELLS, BLANK_CAPTURES, APART_MM, DUST = 4, 11, 50.0, 10
#: Half sizes [mm] of the plate before the background: about 70 % of what a camera sees.
SMALL_PLATE, BACKGROUND_CELLS = (190.0, 140.0), 3
#: The print: period, cell [mm], range of its reflectance.
PERIOD_MM, CELL_MM, REFLECTANCE, PRINT_CELLS = 40.0, 2.0, (0.7, 1.0), 3
#: Columns and rows of regular patterns with an end, by pitch [mm]: no turn leads such a chessboard onto itself. How far
#: from the middle captures stand [mm]: with the ends in view, and without.
PATTERNS = {5: (30, 21), 20: (9, 6), 40: (5, 4)}
ENDS_WITHIN_MM, ENDLESS_WITHIN_MM = 40.0, 110.0
#: The identity moves a point by less than this where the background is taken for the part [mm].
STILL_MM = 1.0
BOARD, CORNERS = ROOT / "tests" / "real" / "procam_board", (9, 7)
#: The board's square measures 75 of its units: an error of a hundredth of it, as planish's 1 mm of a 75 mm square.
DATA = ROOT.parent / "shared" / "data" / "procam_board"


def _half(scene: Scene) -> Scene:
    return replace(scene, sensor=replace(scene.sensor, samples_per_px=HALF_SAMPLES))


def run_blank(number: int) -> Rows:
    """Return the records of all pairs of captures of a plate without texture."""
    rng = np.random.default_rng([number, 31])
    scene = _half(make_scene("blank", number, scale=0.5))
    scene = replace(scene, sensor=replace(scene.sensor, dust=DUST))
    at: list[Array] = []
    while len(at) < BLANK_CAPTURES:
        trial = rng.uniform(-1, 1, 2) * (280, 180)
        if all(np.hypot(*(trial - other)) >= APART_MM for other in at):
            at.append(trial)
    places = [place_sensor(scene.surface, *xy, _roll(rng, k), _tilt(rng)) for k, xy in enumerate(at)]
    return _pairs("blank", scene.seen_from(places))


def _roll(rng: np.random.Generator, k: int) -> float:
    # Half of the captures are not turned: only then does what is fixed to the sensor agree with itself.
    return 0.0 if k % 2 == 0 else float(rng.uniform(0, 360))


def _tilt(rng: np.random.Generator) -> tuple[float, float]:
    x, y = rng.uniform(-8, 8, 2)
    return float(x), float(y)


def run_background(number: int, textured: bool) -> Rows:
    """Return the records of all pairs of captures of a small plate before a background that stands still."""
    rng = np.random.default_rng([number, 32])
    scene = _half(make_scene("plate", 400 + number, scale=0.5))
    scene = replace(scene, surface=Plate(*SMALL_PLATE), background=Background(z_mm=-60.0))
    if not textured:
        scene = replace(scene, texture=BLANK)
    rolls = rng.uniform(-30, 30, 4)
    places = [place_sensor(scene.surface, *rng.uniform(-40, 40, 2), roll, _tilt(rng)) for roll in rolls]
    return _pairs("background, textured part" if textured else "background, blank part", scene.seen_from(places))


def run_print(number: int) -> Rows:
    """Return the records of all pairs of captures of a repeating print."""
    rng = np.random.default_rng([number, 33])
    cells = round(PERIOD_MM / CELL_MM)
    pattern = raster_print(rng.uniform(*REFLECTANCE, (cells, cells)), (CELL_MM, CELL_MM), repeat=(True, True))
    scene = replace(_half(make_scene("blank", 500 + number, scale=0.5)), printed=pattern)
    rolls = rng.uniform(0, 360, 4)
    places = [place_sensor(scene.surface, *rng.uniform(-110, 110, 2), roll, _tilt(rng)) for roll in rolls]
    return _pairs("repeating print", scene.seen_from(places))


def run_pattern(pattern: Pattern, pitch_mm: int, endless: bool) -> Rows:
    """Return the records of all pairs of three captures of a regular pattern."""
    rng = np.random.default_rng([pitch_mm, 34])
    printed = pattern_print(pattern, pitch_mm, *PATTERNS[pitch_mm], endless)
    scene = replace(_half(make_scene("blank", 600 + pitch_mm, scale=0.5)), printed=printed)
    reach = ENDLESS_WITHIN_MM if endless else ENDS_WITHIN_MM
    rolls = rng.uniform(0, 360, 3)
    places = [place_sensor(scene.surface, *rng.uniform(-reach, reach, 2), roll, _tilt(rng)) for roll in rolls]
    return _pairs(f"{pattern}, {'endless' if endless else 'its ends in view'}", scene.seen_from(places))


def _pairs(kind: str, scene: Scene) -> Rows:
    measured = [measure_scene(scene, k) for k in range(len(scene.names))]
    T = {m.name: T for m, T in zip(measured, scene.T_object_sensor, strict=True)}
    half = np.array([scene.surface.half_s, scene.surface.half_t])

    def on_part(name: str, points: Array) -> Array:
        at = transform_points(T[name], points)
        return points[(np.abs(at[:, :2]) <= half).all(1) & (np.abs(at[:, 2]) < 5)]

    return _register(kind, measured, lambda a, b: invert(T[a]) @ T[b], on_part)


def _register(
    kind: str,
    measured: Sequence[Measurement],
    truth: Callable[[str, str], Array],
    on_part: Callable[[str, Array], Array],
    unit: float = 1.0,
) -> Rows:
    options, prepared = prepare_run(measured, threads=1)
    rows: Rows = []
    for a, b in combinations([m.name for m in measured], 2):
        result = register_pair(prepared[a], prepared[b], options, 1, 1)
        m = prepared[b].measurement
        points = m.points_sensor[m.valid].astype(float)[::50]
        part = on_part(b, points)
        rows.append({
            "kind": kind, "a": a, "b": b, "status": result.status, "reason": result.reason,
            "places": result.consensus, "log10_false_alarms": round(result.log10_false_alarms, 2),
            "part_share": round(len(part) / max(1, len(points)), 3),
            "error_mm": _in_units(error_mm(result.T_a_b, truth(a, b), part), unit),
            "moved_mm": _in_units(error_mm(result.T_a_b, np.eye(4), part), unit),
        })  # fmt: skip
    return rows


def _in_units(length: float | None, unit: float) -> float | None:
    return None if length is None else round(length / unit, 5)


def run_board(calibrated: bool) -> Rows:
    """Return the records of the pairs of three real views of a chessboard; lengths as if its square were 20 mm."""
    rig = _calibrated() if calibrated else None
    captures = [Capture.load(BOARD / f"capture_{k}.json", DATA) for k in range(3)]
    measured, corners = [], {}
    for k, capture in enumerate(captures):
        m = replace(measure(capture, rig=rig, threads=1), name=f"board{k}")
        white = capture.read_image("A", 40)
        found, pixels = cv2.findChessboardCorners(white, CORNERS)
        assert found, "the real chessboard is seen whole"
        pixels = pixels.reshape(-1, 2)
        # Half a turn leads this board onto itself, and OpenCV begins at either end; no view is turned by a quarter.
        pixels = pixels if pixels[-1, 1] > pixels[0, 1] else pixels[::-1]
        board = np.zeros(white.shape, np.uint8)
        cv2.fillConvexPoly(board, cv2.convexHull(pixels.round().astype(np.int32)), 1)
        corners[m.name] = _on_plane(m, board > 0, pixels)
        measured.append(m)

    def truth(a: str, b: str) -> Array:
        return fit_rigid(corners[a], corners[b])

    # Between the corners the board is known to be; 63 points say enough about a transform.
    kind = f"real chessboard, {'calibrated by planish' if calibrated else 'by its author'}"
    return _register(kind, measured, truth, lambda name, _: corners[name], unit=75.0 / 20.0)


def _calibrated() -> Rig:
    """Return the rig that planish finds by the same board in five views; the paper is not flat."""
    return calibrate(observe_boards(BOARD / "boards.json", images_dir=DATA), CalibrateOptions(flatness=True)).rig


def _on_plane(m: Measurement, board: np.ndarray, pixels: Array) -> Array:
    """Return the points (N, 3) where the rays of pixels (N, 2) meet the plane of the measured board."""
    points = m.points_sensor[board & m.valid].astype(float)
    use = np.ones(len(points), bool)
    for _ in range(5):
        centre = points[use].mean(0)
        normal = np.linalg.svd((points[use] - centre)[::7], full_matrices=False)[2][2]
        distance = (points - centre) @ normal
        use = np.abs(distance) < 4 * 1.4826 * np.median(np.abs(distance))
    rays = m.camera.rays_sensor(pixels)
    eye = m.camera.center_sensor
    return np.asarray(eye + rays * (((centre - eye) @ normal) / (rays @ normal))[:, None], float)


def save_tables() -> None:
    """Save the table `not-texture` and print what was accepted."""
    rows, table = read_rows(FOLDER), []
    for kind in dict.fromkeys(r["kind"] for r in rows):
        of_it = [r for r in rows if r["kind"] == kind]
        accepted = [r for r in of_it if r["status"] == "accepted"]
        counts: Mapping[str, int] = Counter(r["status"] for r in of_it)
        # Right can only be what truth can tell: on a blank plate nothing can be known.
        right = sum(kind != "blank" and r["error_mm"] <= RIGHT_MM for r in accepted)
        table.append({
            "what": kind, "pairs": len(of_it), "refused": counts["refused"], "ambiguous": counts["ambiguous"],
            "right": right, "wrong": len(accepted) - right,
            "still": sum(r["moved_mm"] is not None and r["moved_mm"] <= STILL_MM for r in accepted),
        })  # fmt: skip
        for r in accepted:
            if kind == "blank" or r["error_mm"] > RIGHT_MM:
                print(r)
    columns = {
        "what": "what is seen", "pairs": "pairs", "refused": "refused", "ambiguous": "ambiguous",
        "right": "accepted, right", "wrong": "accepted, wrong", "still": "of them standing still",
    }  # fmt: skip
    if table:
        save_table("not-texture", columns, table, "python benchmarks/not_texture.py", machine=machines(FOLDER))
        print(*table, sep="\n")


def main() -> None:
    arguments = cell_arguments(__doc__).parse_args()
    if not arguments.tables:
        run = partial(run_cells, FOLDER, workers=arguments.workers, again=arguments.again)
        run({f"blank_{n}": (n,) for n in range(BLANK_CELLS)}, run_blank)
        both = {
            f"background_{n}_{'textured' if t else 'blank'}": (n, t)
            for n in range(BACKGROUND_CELLS)
            for t in (True, False)
        }
        run(both, run_background)
        run({f"print_{n}": (n,) for n in range(PRINT_CELLS)}, run_print)
        patterns: tuple[Pattern, ...] = ("chessboard", "dots")
        endless = {True: "endless", False: "ends"}
        run(
            {
                f"{pattern}_{pitch}_{endless[e]}": (pattern, pitch, e)
                for pattern in patterns
                for pitch in PATTERNS
                for e in endless
            },
            run_pattern,
        )
        if DATA.is_dir():
            run({"board": (False,), "board_calibrated": (True,)}, run_board)
        else:
            print(f"left out, for the real captures are not here: {DATA}", file=sys.stderr)
    save_tables()


if __name__ == "__main__":
    main()
