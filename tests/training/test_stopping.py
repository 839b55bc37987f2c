"""When a training stops: the plateau's logic, and signals."""

import math
import os
import signal
import time
from threading import Timer

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from qnerf.kernels.jit import jit
from qnerf.training import stop_requests
from qnerf.training.stopping import Plateau

psnrs = st.lists(st.floats(0, 50), max_size=30)


def fed(values, patience=3, least=0.1, every=10):
    plateau = Plateau(every, patience, least)
    for value in values:
        plateau.add(value)
    return plateau


@given(psnrs, st.integers(1, 5), st.floats(0, 2))
def test_plateau_is_reached_after_so_many_checks_without_a_gain(values, patience, least):
    plateau = Plateau(10, patience, least)
    best, since = -math.inf, 0
    for value in values:
        assert plateau.reached == (since >= patience)
        plateau.add(value)
        gained = value >= best + least
        best, since = (value, 0) if gained else (best, since + 1)
    assert plateau.reached == (since >= patience)
    assert plateau.best <= max(values, default=-math.inf)


def test_a_psnr_that_is_no_number_is_no_gain():
    assert fed([20.0, math.nan, math.nan, math.nan]).reached


@given(psnrs)
def test_plateau_that_is_off_is_never_due_and_never_reached(values):
    plateau = fed(values, every=0, patience=1)
    assert not plateau.reached
    assert not any(plateau.due(step) for step in range(100))


@given(psnrs, psnrs)
def test_plateau_goes_on_from_its_state(before, after):
    whole, parts = fed(before), Plateau(10, 3, 0.1)
    parts.load(whole.state())
    for value in after:
        whole.add(value)
        parts.add(value)
    assert parts == whole


@jit
def until(start, stop, done, work):
    """Counts until `done` is set, at most up to `stop`."""
    for step in range(start, stop):
        if done[0]:
            break
        work[step & 7] += done[0] + 1


@pytest.mark.parametrize("kind", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_is_heard_while_a_compiled_loop_keeps_python_from_it(monkeypatch, kind):
    done, heard, said = np.zeros(1, np.int64), [], ["not yet", "stopped at step 3"]
    until(0, 1, done, np.zeros(8, np.int64))  # compiled

    def end(message):
        heard.append((message, list(stops)))
        done[0] = 1

    monkeypatch.setattr(stop_requests, "GRACE", 0.0)
    monkeypatch.setattr(stop_requests, "end", end)
    before = signal.getsignal(kind)
    with stop_requests.stop_requests(lambda: None if said.pop(0) == "not yet" else "stopped at step 3") as stops:
        Timer(0.1, os.kill, (os.getpid(), kind)).start()
        until(0, 10**11, done, np.zeros(8, np.int64))
    assert heard[0] == ("stopped at step 3", [])  # Python had not seen it yet
    assert stops == [kind]
    assert signal.getsignal(kind) is before


def test_a_program_of_somebody_s_own_is_interrupted_and_not_ended(monkeypatch):
    """By a KeyboardInterrupt in its main thread, once nothing would be lost by it."""
    monkeypatch.setattr(stop_requests, "GRACE", 0.0)
    said = [None, None, "stopped at step 3"]

    def waits():
        with stop_requests.stop_requests(lambda: said.pop(0)) as stops:
            os.kill(os.getpid(), signal.SIGTERM)
            for _ in range(6000):
                time.sleep(0.01)
            pytest.fail(f"not interrupted, got {stops}")

    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # which a job in the background ignores
    try:
        with pytest.raises(KeyboardInterrupt):
            waits()
    finally:
        signal.signal(signal.SIGINT, before)
    assert said == []
