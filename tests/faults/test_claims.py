"""Concurrent claims in real processes; QNERF_FAULTS=full runs the long form."""

import multiprocessing
import os
import signal

import pytest

from qnerf import records
from qnerf.records import RunStore

ROUNDS = 100 if os.environ.get("QNERF_FAULTS") == "full" else 10
CONTENDERS = 3
PATIENCE = 60  # seconds, for a busy machine
FORK = multiprocessing.get_context("fork")


def begin(store, name, finish):
    """The owner before: it finishes, or is killed."""
    run = store.claim(name, {"seed": 0}).run
    run.finish() if finish else os.kill(os.getpid(), signal.SIGKILL)


def contend(store, name, force, gate, answers):
    gate.wait(PATIENCE)
    claim = store.claim(name, {"seed": 0}, force=force)
    answers.put(claim.outcome)
    gate.wait(PATIENCE)  # the winner stays alive until all have answered
    if claim.run is not None:
        claim.run.flush()
        claim.run.finish()


@pytest.mark.parametrize("kind", ["new", "killed", "finished"])
def test_a_claim_is_won_by_one_of_several(tmp_path, kind):
    """Of a run that is new, whose owner was killed, or that is finished and done over by force."""
    store = RunStore(tmp_path)
    for number in range(ROUNDS):
        name, gate, answers = f"a-{number}", FORK.Barrier(CONTENDERS), FORK.Queue()
        if kind != "new":
            before = FORK.Process(target=begin, args=(store, name, kind == "finished"))
            before.start()
            before.join()
        given = (store, name, kind == "finished", gate, answers)
        processes = [FORK.Process(target=contend, args=given) for _ in range(CONTENDERS)]
        for process in processes:
            process.start()
        outcomes = [answers.get(timeout=PATIENCE) for _ in processes]
        for process in processes:
            process.join()
        assert sorted(outcomes) == sorted(["resumed" if kind == "killed" else "new", "busy", "busy"])
        assert [process.exitcode for process in processes] == [0] * CONTENDERS
        assert records.state(tmp_path / name) == "finished"
