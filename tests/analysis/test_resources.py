import shutil

import pandas as pd
import pytest
from qnerf.analysis import load
from qnerf.analysis.pack import main as pack
from qnerf.analysis.tables import resources
from qnerf.analysis.tables.__main__ import main

from tests.helpers.packed_stores import write_run


def measured(shots, noise, p, psnr):
    """Two views, the first with two random seeds where values are random."""
    images = ["a", "a", "b"] if shots else ["a", "b"]
    each = [psnr - 1, psnr + 1, psnr] if shots else [psnr, psnr]
    return [
        {"image": image, "shots": shots, "noise": noise, "p": p, "psnr": value}
        for image, value in zip(images, each, strict=True)
    ]


@pytest.fixture
def store(tmp_path):
    for seed in (0, 1):
        path = write_run(tmp_path / "runs", "qcolor", seed)
        rows = measured(0, "none", 0.0, 25.0 + seed) + measured(1000, "none", 0.0, 22.0 + seed)
        rows += measured(100, "none", 0.0, 18.0)
        if seed == 0:
            rows += measured(0, "depolarizing", 0.01, 20.0)
        rows.append({"image": "c", "shots": 100, "noise": "none", "p": 0.0, "psnr": 0.0})  # not under all: left out
        pd.DataFrame(rows).to_parquet(path / "eval_hardware.parquet", index=False)
    circuits = {
        "one_qubit_gates": [10, 20],
        "two_qubit_gates": [3, 4],
        "depth": [9, 12],
        "view": [36, 36],
        "step": [360, 0],
    }
    pd.DataFrame(circuits).to_parquet(path / "cost.parquet", index=False)
    for seed in (0, 1):
        write_run(tmp_path / "runs", "classical", seed)
    return tmp_path / "runs"


def test_a_row_has_quality_cost_hardware_and_verdict(store):
    table = resources(load.runs(store), ["field"], baseline="field=classical", rate=1000)
    shown = table.text.set_index("field").loc["qcolor"]
    conditions = [name for name in table.text if name.startswith("PSNR, ") and name != "PSNR, dB"]
    assert conditions == ["PSNR, 100 shots, dB", "PSNR, 1,000 shots, dB", "PSNR, depolarizing 0.01, dB"]
    assert shown[conditions].tolist() == ["18.00 ± 0.00", "22.50 ± 0.71", "20.00 (n = 1)"]
    assert shown["gates"] == "37 (n = 1)"
    assert shown["depth"] == "12 (n = 1)"
    assert shown["verdict"]
    row = table.data.loc["qcolor"]
    assert row["cost.view_hours", "mean"] == pytest.approx(72 / 3600)
    steps = load.runs(store)["train.steps"].iloc[0]
    assert row["cost.train_hours", "mean"] == pytest.approx(360 * steps / 3600)
    assert "1 of 2 runs with circuits lack it: qnerf probe RUN cost" in table.notes
    assert table.text.set_index("field").loc["classical", "gates"] == ""


def test_packed_runs_tell_the_same(store, tmp_path):
    text = resources(load.runs(store), ["field"]).markdown()
    pack([str(store), str(tmp_path / "packed")])
    shutil.rmtree(store)
    assert resources(load.runs(tmp_path / "packed"), ["field"]).markdown() == text


def test_runs_that_nobody_probed_have_a_table_too(store, tmp_path, capsys):
    pack([str(store), str(tmp_path / "packed"), "--filter", "field=classical"])
    assert not (tmp_path / "packed" / "eval_hardware.parquet").exists()
    main([str(tmp_path / "packed"), "--rows", "field", "--resources"])
    assert "gates" not in capsys.readouterr().out
