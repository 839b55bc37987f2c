"""Runs rendered under hardware conditions."""

import dataclasses
import shutil

import pandas as pd
import pytest

from qnerf.probes import load, shots_and_noise
from qnerf.probes.shots_and_noise import Condition, evaluate_hardware, grid
from qnerf.quantum import density
from qnerf.records import StoreError
from qnerf.training import forecast


@pytest.fixture
def path(quantum_run, tmp_path):
    return shutil.copytree(quantum_run, tmp_path / "copy")


def test_hardware_rows_join_the_table_and_more_shots_come_nearer_to_the_exact_picture(path):
    lines = []
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


def test_hardware_rows_of_another_command_meanwhile_stay(path):
    meanwhile = []

    def tell(_):
        if not meanwhile:
            meanwhile.append(evaluate_hardware(load(path), [Condition(shots=7)]))

    table = evaluate_hardware(load(path), [Condition(), Condition(shots=4)], tell=tell)
    assert sorted(table["shots"].unique()) == [0, 4, 7]


def test_conditions_that_do_not_exist_are_one_line():
    for options, message in (
        ({"shots": -1}, "shots must be between 0 and 1000000000, got -1"),
        ({"noise": "thermal", "p": 0.1}, "unknown channel 'thermal'; known: depolarizing"),
        ({"noise": "depolarizing", "p": 1.5}, "probability"),
        ({"noise": "depolarizing"}, "belong together"),
    ):
        with pytest.raises(ValueError, match=message):
            Condition(**options)


def test_noise_that_is_slow_is_sampled_with_a_standard_error_and_its_time_told_before(path, monkeypatch):
    monkeypatch.setattr(density, "is_quick", lambda circuit: False)
    monkeypatch.setattr(forecast, "TELL", 0.0)
    lines = []
    conditions = grid([], "depolarizing", [0.01], 0, {"two_qubit": 0.02, "readout": 0.01})
    rows = evaluate_hardware(load(path), conditions, views=1, patterns=3, tell=lines.append)
    assert rows["noise"].tolist() == ["none", "depolarizing two_qubit=0.02 readout=0.01"]
    assert rows["psnr"].nunique() == 2
    assert lines[0].startswith("2 conditions, 1 views: about 0 minutes")
    assert "standard error of a value 0." in lines[2]
    lines.clear()
    evaluate_hardware(load(path), grid([10], "none", [], 0), views=1, tell=lines.append)
    assert lines[0] == "2 conditions, 1 views: about 0 minutes; views= renders fewer"
    monkeypatch.setattr(shots_and_noise, "seconds_of", lambda *_: 1e5)
    with pytest.raises(ValueError, match=r", 1 views: about 1,667 minutes; .*, or run.hours=56 goes on"):
        evaluate_hardware(load(path), grid([10], "none", [], 0), views=1)
    longer = dataclasses.replace(load(path).settings.run, hours=56.0)
    patient = dataclasses.replace(load(path), settings=dataclasses.replace(load(path).settings, run=longer))
    evaluate_hardware(patient, grid([10], "none", [], 0), views=1)
