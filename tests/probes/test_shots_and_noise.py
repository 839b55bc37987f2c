import pandas as pd
import pytest

from qnerf.experiment import run
from qnerf.probes import load
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
    with pytest.raises(ValueError, match="has no circuit"):
        evaluate_hardware(load(run(tiny("field=classical")).path), [Condition()])


def test_noise_that_would_take_hours_is_refused(tiny):
    path = run(tiny("field=qcolor", "qiren=1L2S", "qiren.qubits=12")).path
    with pytest.raises(ValueError, match=r"about .* hours for 1 views; noise is quick for runs with qiren\.spectral=1"):
        evaluate_hardware(load(path), grid([], "depolarizing", [0.01], 0))


def test_hours_are_of_the_samples_that_circuits_see(tiny):
    hours = []
    for parts in (1, 4):
        path = run(
            tiny("field=qcolor", "qiren=1L2S", "qiren.qubits=14", "shading=merge", f"shading.parts={parts}")
        ).path
        with pytest.raises(ValueError, match="about") as refused:
            evaluate_hardware(load(path), grid([], "depolarizing", [0.01], 0))
        hours.append(int(str(refused.value).split("about ")[1].split(" hours")[0].replace(",", "")))
    assert 3 * hours[0] < hours[1] < 4.1 * hours[0]  # where visibility closes a part, it is not evaluated
