import pandas as pd
import pytest

from qnerf.experiment import run
from qnerf.probes import load, shots_and_noise
from qnerf.probes.shots_and_noise import Condition, evaluate_hardware, grid
from qnerf.records import StoreError

SMALL = ("qiren.qubits=3", "train.steps=3")


def test_rows_join_the_table_and_more_shots_come_nearer_to_the_exact_picture(tiny):
    path = run(tiny("field=qcolor", *SMALL)).path
    lines: list[str] = []
    table = evaluate_hardware(load(path), grid([4, 100_000], "none", [], 0), tell=lines.append)
    assert len(lines) == 3
    images = pd.read_parquet(path / "eval.parquet").set_index("image")["psnr"]
    by_shots = {shots: rows.set_index("image")["psnr"] for shots, rows in table.groupby("shots")}
    pd.testing.assert_series_equal(by_shots[0], images, rtol=1e-4)
    few, many = ((by_shots[shots] - by_shots[0]).abs().mean() for shots in (4, 100_000))
    assert many < few

    again = evaluate_hardware(load(path), grid([4], "depolarizing", [0.3], 0), views=1)
    assert len(again) == len(table) + 1
    noisy = again[again["noise"] == "depolarizing"].iloc[0]
    assert (noisy["shots"], noisy["p"]) == (4, 0.3)
    pd.testing.assert_frame_equal(pd.read_parquet(path / "eval_hardware.parquet"), again)
    (path / "eval_hardware.parquet").write_bytes(b"PAR1")
    with pytest.raises(StoreError, match=r"eval_hardware\.parquet"):
        evaluate_hardware(load(path), [Condition()])


def test_rows_of_another_command_meanwhile_stay(tiny):
    path = run(tiny("field=qcolor", *SMALL)).path
    meanwhile = []

    def tell(_: str) -> None:
        if not meanwhile:
            meanwhile.append(evaluate_hardware(load(path), [Condition(shots=7)]))

    table = evaluate_hardware(load(path), [Condition(), Condition(shots=4)], tell=tell)
    assert sorted(table["shots"].unique()) == [0, 4, 7]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"shots": -1}, "shots must be at least 0, got -1"),
        ({"noise": "thermal", "p": 0.1}, "unknown channel 'thermal'; known: depolarizing"),
        ({"noise": "depolarizing", "p": 1.5}, "probability"),
        ({"noise": "depolarizing"}, "belong together"),
    ],
)
def test_a_bad_condition_is_one_line(options, message):
    with pytest.raises(ValueError, match=message):
        Condition(**options)


def test_only_finished_runs_with_circuits_are_evaluated(tiny, tmp_path):
    with pytest.raises(ValueError, match="is not a run"):
        load(tmp_path)
    with pytest.raises(ValueError, match="neither of its heads has a re-uploading circuit"):
        evaluate_hardware(load(run(tiny("field=classical")).path), [Condition()])


def test_noise_of_large_circuits_is_sampled_with_a_standard_error(tiny):
    path = run(tiny("field=qcolor", "qiren=1L2S", "qiren.qubits=6", "train.steps=3")).path
    lines: list[str] = []
    conditions = grid([], "depolarizing", [0.01], 0, {"two_qubit": 0.02, "readout": 0.01})
    rows = evaluate_hardware(load(path), conditions, views=1, patterns=3, tell=lines.append)
    assert rows["noise"].tolist() == ["none", "depolarizing two_qubit=0.02 readout=0.01"]
    assert rows["psnr"].nunique() == 2
    assert "standard error of a value 0." in lines[-1]


def test_the_time_of_slow_noise_is_told_before(tiny, monkeypatch):
    path = run(tiny("field=qcolor", "qiren=1L2S", "qiren.qubits=6", "train.steps=3")).path
    monkeypatch.setattr(shots_and_noise, "TELL", 0.0)
    lines: list[str] = []
    evaluate_hardware(load(path), [Condition(noise="bit_flip", p=0.1)], views=1, patterns=2, tell=lines.append)
    assert "about 0 minutes for 1 views" in lines[0]
