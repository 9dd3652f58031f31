"""Kernels of the C++ core: arrays in, arrays out. Callers check shapes; nothing here is public."""

import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

def cpu_has_avx2() -> bool: ...
def cpu_count() -> int: ...

# Registration
def fit_surface(points: F32, camera: F64, radius: int, max_slope: float, threads: int) -> tuple[F32, F32, F32]: ...
