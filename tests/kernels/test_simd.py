"""Vectors follow the processor that Numba compiles for, which need not be the one that it runs on."""

import os
import platform
import subprocess
import sys

import pytest

GATHER = """
import numpy as np
from qnerf.kernels.jit import jit
from qnerf.kernels.simd import VECTOR_BYTES, gather, lanes, store

@jit
def gathered(array, rows, out):
    store(out, 0, gather(array, rows, 0))

rows = np.arange(lanes(4), dtype=np.uint32)[::-1].copy()
out = np.zeros(len(rows), np.float32)
gathered(np.arange(len(rows), dtype=np.float32), rows, out)
assert VECTOR_BYTES == 32 and np.array_equal(out, rows)
"""


@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="haswell is an x86 processor")
def test_vectors_of_another_processor(tmp_path):
    script = tmp_path / "gather.py"
    script.write_text(GATHER)
    target = {"NUMBA_CPU_NAME": "haswell", "NUMBA_CPU_FEATURES": "", "NUMBA_CACHE_DIR": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, script], env=os.environ | target, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
