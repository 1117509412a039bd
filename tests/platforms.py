"""Environment variables under which this machine computes like one with fewer instruction sets."""

import numpy as np

_FOUND = np.show_config(mode="dicts").get("SIMD Extensions", {}).get("found", [])  # type: ignore[union-attr]

AVX2 = {
    "NPY_DISABLE_CPU_FEATURES": " ".join(_FOUND[1:]),
    "ATEN_CPU_CAPABILITY": "avx2",
    "MKL_CBWR": "AVX2",
}
"""NumPy, torch and MKL without AVX-512."""

BASELINE = {
    "NPY_DISABLE_CPU_FEATURES": " ".join(_FOUND),
    "ATEN_CPU_CAPABILITY": "default",
    "MKL_CBWR": "COMPATIBLE",
    "OPENBLAS_CORETYPE": "Prescott",
    "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-AVX512F,-FMA",
}
"""The same libraries, and the C library's mathematics, without vectors and fused products."""

OTHER_PLATFORMS = {"avx2": AVX2, "baseline": BASELINE}
