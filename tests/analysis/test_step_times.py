"""When times of runs can be compared, and what tables do when they cannot."""

import pandas as pd
import pytest
from qnerf.analysis.load import runs
from qnerf.analysis.step_times import incomparable
from qnerf.analysis.tables import ablation

from tests.helpers.packed_stores import write_run

OTHER = {
    "measured on 2 machines": {"machine": "b"},
    "measured with 1, 2 threads": {"time.threads": 1},
    "measured under loads of 0.5 to 1.3 processes for each core": {"time.load": 1.3},
    "for 1 of 2 runs machine, threads or load are unknown": {"time.load": None},
}


@pytest.mark.parametrize("reason", OTHER)
def test_a_table_ranks_no_times_that_are_not_comparable(tmp_path, reason):
    write_run(tmp_path, "classical", results={"step_ms": 30.0, "step_cpu_ms": 50.0})
    write_run(tmp_path, "qcolor", results={"step_ms": 20.0, "step_cpu_ms": 60.0} | OTHER[reason])
    frame = runs(tmp_path)
    table = ablation(frame, ["field"], values=["psnr", "step_ms", "step_cpu_ms"])
    assert f"time of a step is not ranked: {reason}" in table.notes
    assert not table.bold["time of a step, ms"].any()
    assert table.bold["CPU time of a step, ms"].any() == ("time.load" in OTHER[reason])  # what waits costs no CPU time


def test_times_under_the_same_load_are_ranked(tmp_path):
    for field, load, step in (("classical", 0.3, 30.0), ("qcolor", 1.1, 20.0)):  # a core for each process, nearly
        write_run(tmp_path, field, results={"step_ms": step, "time.load": load})
    table = ablation(runs(tmp_path), ["field"], values=["psnr", "step_ms"])
    assert table.bold["time of a step, ms"].tolist() == [False, True]
    assert not any("ranked" in note for note in table.notes)


def test_step_times_of_one_run_are_compared_with_nothing():
    assert incomparable(pd.DataFrame({"step_ms": [20.0]}), "step_ms") == ""
