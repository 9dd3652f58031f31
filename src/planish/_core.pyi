"""Kernels of the C++ core: arrays in, arrays out. Callers check shapes; nothing here is public."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]
U16 = NDArray[np.uint16]

def cpu_has_avx2() -> bool: ...
def cpu_count() -> int: ...
def release_memory() -> None: ...
def keep_memory(keep: bool) -> None: ...
def allow_huge_pages(allow: bool) -> bool: ...

# Registration
TUKEY: float

def fit_surface(points: F32, camera: F64, radius: int, max_slope: float, threads: int) -> tuple[F32, F32, F32]: ...
def align_texture(
    places: F32,
    own: U8,
    points_a: F32,
    normals_a: F32,
    camera_b: F64,
    points_b: F32,
    value_b: F32,
    sigma_b: F32,
    T_b_a: F64,
    gate: float,
    threads: int,
) -> tuple[F32, F32, F32, U8]: ...
def nearest_pixels(
    points_b: F32, stride: int, camera_a: F64, height_a: int, width_a: int, T_a_b: F64
) -> tuple[NDArray[np.int32], F64]: ...
def joint_values(
    maps: tuple[F32, F32, F32, F32, F32, F32, F32],
    texture: F32,
    slopes: F32,
    centre: F64,
    blur: float,
    blur_sigma: float,
    spacing: int,
    threads: int,
) -> F32: ...
def window_moments(
    image: F32,
    taps: Sequence[Sequence[float]],
    pairs: Sequence[tuple[int, int]],
    step: int,
    shape: tuple[int, int],
    threads: int,
) -> F32: ...
def spectrum_products(first: F32, second: F32, step: int, threads: int) -> F32: ...
def weigh_spectrum(spectrum: F32, cells: F32, step: int, shading: float, threads: int) -> None: ...
def nearest_descriptors(
    a: U8, size_a: F64, b: U8, size_b: F64, max_size_ratio: float, threads: int
) -> tuple[NDArray[np.int32], NDArray[np.int32]]: ...
def align_patches(
    charts_a: list[F32],
    places_a: F64,
    chart_a: NDArray[np.int32],
    charts_b: list[F32],
    places_b: F64,
    chart_b: NDArray[np.int32],
    pairs: NDArray[np.int32],
    radius: int,
    reach: int,
    turns: int,
    turn_step: float,
    threads: int,
) -> F64: ...
def chart_coordinates(
    points: F32, nodes: F32, step: int, max_height: float, threads: int
) -> tuple[F32, U8, tuple[float, float, float, float]]: ...
def rasterise_chart(
    coordinates: F32, x: float, y: float, pitch: float, max_edge: float, height: int, width: int, threads: int
) -> F32: ...
def chart_surface(
    source: F32, points: F32, normals: F32, nodes: F32, step: int, threads: int
) -> tuple[F32, F32, F32]: ...
def sample_chart(
    value: F32, sigma: F32, known: U8, source: F32, interpolated: float, threads: int
) -> tuple[F32, F32, U8]: ...
def block_sums(image: F32, low: float, high: float, seen: U8, factor: int, threads: int) -> tuple[F32, F32]: ...
def block_centres(image: F32, factor: int) -> F32: ...
def mark_blocks(places: F32, factor: int, height: int, width: int) -> U8: ...
def fill_gaps(blocks: F32, otherwise: float) -> F32: ...
def lambert(points: F32, normals: F32, source: F64, least_cosine: float) -> F32: ...
def contrast_scatter(
    images: tuple[F32, F32],
    ranges: tuple[tuple[float, float], tuple[float, float]],
    seen: U8,
    levels: tuple[F32, F32],
    expected: F32,
    factor: int,
    step: int,
) -> tuple[int, float]: ...
def local_planes(
    total: F32, weight: F32, bell: Sequence[float], least_weight: float, thin: float, steepest: float, threads: int
) -> F32: ...
def camera_contrast(
    images: Sequence[F32],
    ranges: Sequence[tuple[float, float]],
    seen: U8,
    level: Sequence[F32],
    variance: Sequence[F32],
    covariance: F32,
    noise_left: float,
    factor: int,
    limit: float,
    threads: int,
) -> tuple[F32, F32, F32]: ...
def add_to_pattern(value: F32, weight: F32, factor: int, sum: F32, weights: F32, threads: int) -> None: ...
def remove_pattern(
    band: F32,
    own: F32,
    knowledge: tuple[F32, F32, F32, F32, F32],
    factor: int,
    share: float,
    rest: F32,
    uncertain: F32,
    threads: int,
) -> None: ...
def split_bands(value: F32, bell: Sequence[float], factor: int, threads: int) -> tuple[F32, F32, F32, F32, F32]: ...
def compensated_image(
    value: F32, variance: F32, level: F32, factor: int, place: F32, seen: U8, gain: float, threads: int
) -> tuple[F32, F32, F32, F32]: ...
def merge_contrasts(
    images: Sequence[tuple[F32, F32, F32, F32]], valid: U8, factor: int, threads: int
) -> tuple[F32, F32]: ...
def find_consensus(
    points_a: F64,
    points_b: F64,
    frames_a: F64,
    frames_b: F64,
    tolerance: float,
    frame_angle: float,
    normal_angle: float,
    distinct: float,
    keep: int,
    threads: int,
) -> tuple[F64, NDArray[np.int32]]: ...
def count_places(points: F64, distinct: float) -> int: ...

_Maps = tuple[F32, F32, NDArray[np.uint8]]
_Normal = tuple[F64, F64, float, int, float, F64]

def joint_normal_equations(
    maps_a: _Maps,
    camera_a: F64,
    maps_b: _Maps,
    T_a_b: F64,
    about: F64,
    options: tuple[float, float, int, int],
    weights: F32,
    with_residuals: bool,
    threads: int,
) -> tuple[_Normal, _Normal, F64, F64, float, F64, F64, F64, F32, F32]: ...
def joint_samples(
    maps_a: _Maps, camera_a: F64, maps_b: _Maps, T_a_b: F64, options: tuple[float, float, int, int], threads: int
) -> tuple[F64, F32, NDArray[np.int64]]: ...
def joint_pull(
    maps_a: _Maps,
    camera_a: F64,
    maps_b: _Maps,
    T_a_b: F64,
    about: F64,
    options: tuple[float, float, int, int],
    weights: F32,
    threads: int,
) -> tuple[F64, NDArray[np.int64]]: ...

# Evaluation
def look_up_distance(
    points_a: F32,
    normals_a: F32,
    camera_a: F64,
    points_b: F32,
    normals_b: F32,
    T_a_b: F64,
    max_distance: float,
    with_pixels: bool,
    threads: int,
) -> tuple[F32, F32]: ...
def known_distances(distances: F32, areas: F32, threads: int) -> tuple[int, float, float]: ...
def pixel_areas(tangents: F32, threads: int) -> F32: ...
def cell_medians(map: F32, size: int, min_count: int, threads: int) -> F32: ...
def tile_shifts(
    value_a: F32,
    sigma_a: F32,
    value_b: F32,
    sigma_b: F32,
    pixels_b: F32,
    tiles: F64,
    size: int,
    start_1: float,
    start_2: float,
    threads: int,
) -> F64: ...
def common_shift(
    value_a: F32,
    sigma_a: F32,
    value_b: F32,
    sigma_b: F32,
    pixels_b: F32,
    tiles: F64,
    size: int,
    start_1: float,
    start_2: float,
    threads: int,
) -> tuple[float, float]: ...
def shift_scores(
    value_a: F32,
    sigma_a: F32,
    value_b: F32,
    sigma_b: F32,
    pixels_b: F32,
    tiles: F64,
    size: int,
    shifts: F64,
    threads: int,
) -> F64: ...

# --- simulation ---
def render_images_8(
    scene: dict[str, Any], patterns: dict[str, Any], sensor: dict[str, Any], out: NDArray[np.uint8], threads: int
) -> None: ...
def render_images_16(
    scene: dict[str, Any], patterns: dict[str, Any], sensor: dict[str, Any], out: NDArray[np.uint16], threads: int
) -> None: ...
def trace_image(scene: dict[str, Any], points: NDArray[np.float64], lit: NDArray[np.uint8], threads: int) -> None: ...
def intersect_surface(
    surface: dict[str, Any], origins: NDArray[np.float64], directions: NDArray[np.float64], hits: NDArray[np.float64]
) -> None: ...
def texture_albedo(texture: dict[str, Any], at: NDArray[np.float64], out: NDArray[np.float64]) -> None: ...
def print_factor(
    print: dict[str, Any], at: NDArray[np.float64], footprints: NDArray[np.float64], out: NDArray[np.float64]
) -> None: ...
def normal_numbers(seed: int, stream: int, out: NDArray[np.float32]) -> None: ...

# --- sensing (an optional array that is absent has size 0) ---

def decode_phase(
    images: Sequence[NDArray[Any]],
    counts: Sequence[int],
    angles_cos: Sequence[float],
    angles_sin: Sequence[float],
    periods: Sequence[float],
    coarse: F32,
    settings: dict[str, Any],
    threads: int,
) -> tuple[F32, F32, F32, F32, U16]: ...
def sample_disagreement(
    images: Sequence[NDArray[Any]],
    counts: Sequence[int],
    angles_cos: Sequence[float],
    angles_sin: Sequence[float],
    periods: Sequence[float],
    coarse: F32,
    settings: dict[str, Any],
    rows: Sequence[int],
    threads: int,
) -> tuple[F32, F32, F32, F32]: ...
def decode_gray(images: Sequence[NDArray[Any]], inverse: Sequence[int], threshold: F32, threads: int) -> F32: ...
def gray_edges(
    images: Sequence[NDArray[Any]],
    inverse: Sequence[int],
    white: int,
    black: int,
    cell_px: float,
    saturation: float,
    noise_offset: float,
    noise_slope: float,
    max_signal_sigma: float,
    edge_bias_px: float,
    threads: int,
) -> tuple[F32, F32, F32, F32, U16]: ...
def undistortion_shifts(camera: F64, height: int, width: int, threads: int) -> F32: ...
def repair_periods(
    position: F32,
    sigma: F32,
    rejected: U16,
    period_px: float,
    tolerance_px: float,
    sigmas: float,
    reflection_pixels: int,
    threads: int,
) -> None: ...
def sample_noise(
    images: Sequence[NDArray[Any]],
    weights: Sequence[float],
    rows: Sequence[int],
    along_rows: bool,
    level_beside: bool,
    saturation: float,
) -> tuple[F32, F32]: ...
def bin_noise(
    level: F32, residual: F32, bins: int, clip_sigmas: float, min_sigma: float
) -> tuple[F64, F64, NDArray[np.int64]]: ...
def phase_edges(
    position: F32, sigma: F32, rejected: U16, jump_px: float, sigmas: float, reason: int, threads: int
) -> tuple[F32, F32, U16]: ...
def temporal_statistics(images: Sequence[NDArray[Any]], saturation: float, threads: int) -> tuple[F32, F32, U8]: ...
def correlate(
    own_images: Sequence[NDArray[Any]],
    own_shift: F32,
    other_images: Sequence[NDArray[Any]],
    other_shift: F32,
    noise: F32,
    F: F64,
    min_steps: int,
    max_loss: F32,
    sure_loss: F32,
    max_misfit: F32,
    model_loss: float,
    min_gap: float,
    range_px: F32,
    range_spacing: int,
    threads: int,
) -> tuple[F32, F32, U16]: ...
def correspond(
    own_position: F32,
    own_sigma: F32,
    own_shift: F32,
    other_position: F32,
    other_sigma: F32,
    other_camera: F64,
    transposed: bool,
    F: F64,
    threads: int,
) -> tuple[F32, F32]: ...
def triangulate(own: F64, own_shift: F32, other: F64, pixel: F32, sigma: F32, threads: int) -> tuple[F32, F32, F32]: ...
def projector_residual(
    projector: F64,
    axis: int,
    center: F64,
    points: F32,
    sigma_mm: F32,
    position: F32,
    position_sigma: F32,
    threads: int,
) -> tuple[F32, F32]: ...
def check_points(
    points: F32,
    sigma_mm: F32,
    miss: F32,
    position: F32,
    position_sigma: F32,
    rejected: U16,
    own: F64,
    projector: F64,
    axis: int,
    limits: Sequence[float],
    reasons: Sequence[int],
    threads: int,
) -> tuple[U16, F32]: ...
def drop_rejected(rejected: U16, values: F32, threads: int) -> None: ...
def intersect(
    own: F64,
    own_shift: F32,
    projector: F64,
    width: int,
    height: int,
    position_u: F32,
    sigma_u: F32,
    position_v: F32,
    sigma_v: F32,
    primary: int,
    threads: int,
) -> tuple[F32, F32, F32, F32]: ...
def grazing_points(
    depth: F32,
    sigma: F32,
    position: F32,
    pixel_size: float,
    max_slope: float,
    rim_px: float,
    sigmas: float,
    threads: int,
) -> U8: ...
def islands(
    depth: F32, sigma: F32, excluded: U8, depth_per_pixel: float, sigmas: float, min_pixels: int, threads: int
) -> U8: ...
def shift_sums(
    first: F32,
    last: F32,
    usable: U8,
    noise_offset: float,
    noise_slope: float,
    share_first: float,
    share_last: float,
    threads: int,
) -> F64: ...
