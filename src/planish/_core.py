"""Choose the kernels for this processor: AVX2 + FMA where present, else the baseline build."""

from importlib import import_module

from planish import _core_baseline

_chosen = import_module("planish._core_avx2") if _core_baseline.cpu_has_avx2() else _core_baseline

globals().update({name: value for name, value in vars(_chosen).items() if not name.startswith("_")})
