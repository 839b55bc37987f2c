"""Sharing a loop among threads, and compiling it: kernels/jit.py."""

import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from qnerf.kernels import jit as module
from qnerf.kernels.jit import jit, loop_threads, one_torch_thread, run

SOURCE = Path(module.__file__).parents[2]


@jit
def _square(start, stop, values, out):
    for i in range(start, stop):
        out[i] += values[i] ** 2


@settings(max_examples=40)
@given(items=st.integers(0, 300), count=st.integers(1, 5), grain=st.none() | st.integers(1, 400))
def test_every_item_is_worked_on_once_whatever_the_threads(items, count, grain):
    torch.set_num_threads(count)
    values, out = np.arange(items, dtype=float), np.zeros(items)
    run(_square, items, values, out, grain=grain)
    np.testing.assert_array_equal(out, values**2)


def test_grain_keeps_small_loops_on_the_calling_thread():
    torch.set_num_threads(2)
    seen = []
    run(lambda start, stop: seen.append((start, stop, threading.current_thread())), 100, grain=64)
    assert seen == [(0, 100, threading.current_thread())]


def test_a_part_may_run_kernels_itself():
    torch.set_num_threads(2)
    out = np.zeros((4, 64))

    def outer(start, stop):
        for row in range(start, stop):
            run(_square, 64, np.ones(64), out[row], grain=1)

    worker = threading.Thread(target=run, args=(outer, 4), kwargs={"grain": 1})
    worker.start()
    worker.join(60)
    assert not worker.is_alive()
    np.testing.assert_array_equal(out, 1)


@pytest.mark.parametrize("part", [0, 1])
def test_a_failure_in_any_part_is_raised_after_all_parts_ended(part):
    torch.set_num_threads(2)
    ended = []

    def kernel(start, stop):
        if start == 5 * part:
            raise ZeroDivisionError("here")
        time.sleep(0.02)
        ended.append(start)

    with pytest.raises(ZeroDivisionError, match="here"):
        run(kernel, 10)
    assert ended == [5 * (1 - part)]


def test_a_forked_child_starts_threads_of_its_own():
    code = """
import os, sys, warnings
import numpy as np, torch
from qnerf.kernels.jit import run
warnings.simplefilter("ignore")
torch.set_num_threads(2)
def kernel(start, stop, out):
    out[start:stop] += 1
run(kernel, 10, np.zeros(10))
pid = os.fork()
if pid == 0:
    out = np.zeros(10)
    run(kernel, 10, out)
    os._exit(0 if (out == 1).all() else 1)
sys.exit(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]))
"""
    assert _python(code).returncode == 0


COMPILES = """
import gc
import numpy as np
from kernels_for_test import double
out = np.zeros(8)
double(0, 8, out)
double(0, 8, out.astype(np.float32))
assert (out == 1).all()
assert gc.isenabled()
"""
KERNEL = """
from qnerf.kernels.jit import jit

@jit
def double(start, stop, out):
    for i in range(start, stop):
        out[i] += 1
"""


def test_compilation_is_announced_once_and_only_when_it_happens(tmp_path):
    (tmp_path / "kernels_for_test.py").write_text(KERNEL)
    first, second = (_python(COMPILES, tmp_path) for _ in range(2))
    assert first.returncode == second.returncode == 0
    assert first.stderr.count("\n") == 1
    assert first.stderr == "compiling kernels, once for this environment\n"
    assert second.stderr == ""


def test_kernels_work_where_no_cache_can_be_written(tmp_path):
    (tmp_path / "kernels_for_test.py").write_text(KERNEL)
    # A file where a folder would have to be made stands for read-only folders: root may write into those.
    blocked = tmp_path / "blocked"
    blocked.write_text("")
    (tmp_path / "__pycache__").write_text("")
    result = _python(COMPILES, tmp_path, HOME=str(blocked), XDG_CACHE_HOME=str(blocked), IPYTHONDIR=str(blocked))
    assert result.returncode == 0, result.stderr


def test_numba_that_may_not_compile_is_refused_in_words():
    result = _python("import qnerf.kernels.hashgrid", NUMBA_DISABLE_JIT="1")
    assert "ValueError: NUMBA_DISABLE_JIT: expected to be unset" in result.stderr


def _python(code, *folders, **environment):
    paths = os.pathsep.join(str(folder) for folder in (SOURCE, *folders))
    variables = {k: v for k, v in os.environ.items() if not k.startswith("NUMBA_")}
    variables |= {"PYTHONPATH": paths, "PYTHONDONTWRITEBYTECODE": "1", **environment}
    return subprocess.run([sys.executable, "-c", code], env=variables, capture_output=True, text=True, timeout=120)


def test_loops_keep_their_threads_where_pytorch_has_one():
    def counts():
        return torch.get_num_threads(), loop_threads()

    torch.set_num_threads(3)
    with one_torch_thread(False):
        assert counts() == (3, 3)
    with one_torch_thread():
        assert counts() == (1, 3)
        with one_torch_thread():
            assert counts() == (1, 3)
        assert counts() == (1, 3)
    assert counts() == (3, 3)
    torch.set_num_threads(2)
    assert loop_threads() == 2


def test_one_torch_thread_is_of_the_thread_that_asks_for_it():
    torch.set_num_threads(3)
    seen = []
    with one_torch_thread():
        other = threading.Thread(target=lambda: (torch.set_num_threads(2), seen.append(loop_threads())))
        other.start()
        other.join()
        assert loop_threads() == 3
    assert seen == [2]
