import shutil

import pandas as pd
import pytest
from qnerf.analysis import load
from qnerf.analysis.pack import main as pack
from qnerf.analysis.tables import resources, units
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


def units_of(when, dead, std):
    """A head with two hidden layers, 12 and 4 units, and another head."""
    return [
        {"when": when, "head": "color", "layer": 0, "kind": "relu", "units": 12, "dead": dead, "std": 9.0},
        {"when": when, "head": "color", "layer": 1, "kind": "relu", "units": 4, "dead": 0.0, "std": 9.0},
        {"when": when, "head": "color", "layer": 2, "kind": "output", "units": 3, "dead": None, "std": std},
        {"when": when, "head": "density", "layer": 0, "kind": "relu", "units": 64, "dead": 1.0, "std": 9.0},
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
        path = write_run(tmp_path / "runs", "classical", seed, [24.0 + seed])
        rows = units_of("start", 0.5, 0.001) + units_of("end", 1.0, 0.5 + seed)
        pd.DataFrame(rows).astype({"dead": "float64"}).to_parquet(path / "units.parquet", index=False)
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
    assert "1 of 2 circuit runs were not probed: qnerf probe RUN cost" in table.notes
    assert table.text.set_index("field").loc["classical", "gates"] == ""
    write_run(store, "qcolor", 2, [26.0] * 3)
    one = pd.DataFrame(measured(0, "none", 0.0, 20.0) + measured(100, "none", 0.0, 19.0))
    one.to_parquet(next(store.glob("*qcolor-s2")) / "eval_hardware.parquet", index=False)
    fewer = resources(load.runs(store, "seed=2"), ["field"]).text.iloc[0]  # two of its three views
    assert fewer[["PSNR, exact, the same views, dB", "PSNR, 100 shots, dB"]].tolist() == ["20.00", "19.00"]


def test_dead_units_and_spread_are_means_over_layers_and_seeds(store):
    table = units(load.runs(store), ["field"])
    row = table.data.xs("mean", axis=1, level=1).loc["classical"]
    assert row["dead @ start"] == pytest.approx(0.5 * 12 / 16)
    assert row["dead @ end"] == pytest.approx(12 / 16)
    assert (row["spread @ start"], row["spread @ end"]) == (pytest.approx(0.001), pytest.approx(1.0))
    assert "| classical | 24.50 ± 0.71 | 2 | 0.38 ± 0.00 | 0.75 ± 0.00 | 0.001 ± 0 | 1 ± 0.7071 |" in table.markdown()
    assert "left out: 2 not probed" in table.markdown()
    with pytest.raises(ValueError, match="no run was probed: qnerf probe RUN units"):
        units(load.runs(store, "field=qcolor"), ["field"])


def test_packed_runs_tell_the_same(store, tmp_path, capsys):
    packed, rest = tmp_path / "packed", tmp_path / "rest"
    told = [make(load.runs(store), ["field"]).markdown() for make in (units, resources)]
    pack([str(store), str(packed)])
    pack([str(store), str(rest), "--filter", "field=qcolor"])
    shutil.rmtree(store)
    assert [make(load.runs(packed), ["field"]).markdown() for make in (units, resources)] == told
    assert not (rest / "units.parquet").exists()
    for flag in ("--units", "--resources", "--stability"):
        main([str(packed), "--rows", "field", flag])
        assert "| classical |" in capsys.readouterr().out
