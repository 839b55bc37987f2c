import shutil

import pandas as pd
import pytest
from qnerf.analysis import load
from qnerf.analysis.pack import main as pack
from qnerf.analysis.tables import units
from qnerf.analysis.tables.__main__ import main

from tests.helpers.packed_stores import write_run


def probed(when, dead, std):
    """What the probe writes of a head with two hidden layers, 12 and 4 units, and of another head."""
    return [
        {"when": when, "head": "color", "layer": 0, "kind": "relu", "units": 12, "dead": dead, "std": 9.0},
        {"when": when, "head": "color", "layer": 1, "kind": "relu", "units": 4, "dead": 0.0, "std": 9.0},
        {"when": when, "head": "color", "layer": 2, "kind": "output", "units": 3, "dead": None, "std": std},
        {"when": when, "head": "density", "layer": 0, "kind": "relu", "units": 64, "dead": 1.0, "std": 9.0},
    ]


@pytest.fixture
def store(tmp_path):
    for seed in (0, 1):
        path = write_run(tmp_path / "runs", "classical", seed, [24.0 + seed])
        rows = probed("start", 0.5, 0.001) + probed("end", 1.0, 0.5 + seed)
        pd.DataFrame(rows).astype({"dead": "float64"}).to_parquet(path / "units.parquet", index=False)
    write_run(tmp_path / "runs", "qcolor", 0)
    return tmp_path / "runs"


def test_dead_units_and_spread_are_means_over_layers_and_seeds(store):
    table = units(load.runs(store), ["field"])
    row = table.data.xs("mean", axis=1, level=1).loc["classical"]
    assert row["dead @ start"] == pytest.approx(0.5 * 12 / 16)
    assert row["dead @ end"] == pytest.approx(12 / 16)
    assert (row["spread @ start"], row["spread @ end"]) == (pytest.approx(0.001), pytest.approx(1.0))
    assert "| classical | 24.50 ± 0.71 | 0.38 ± 0.00 | 0.75 ± 0.00 | 0.001 ± 0 | 1 ± 0.7071 | 2 |" in table.markdown()
    assert "left out: 1 not probed" in table.markdown()


def test_packed_runs_tell_the_same(store, tmp_path):
    text = units(load.runs(store), ["field"]).markdown()
    pack([str(store), str(tmp_path / "packed")])
    shutil.rmtree(store)
    assert units(load.runs(tmp_path / "packed"), ["field"]).markdown() == text


def test_runs_that_nobody_probed_are_one_line(store, tmp_path, capsys):
    with pytest.raises(ValueError, match="no run was probed: qnerf probe RUN units"):
        units(load.runs(store, "field=qcolor"), ["field"])
    pack([str(store), str(tmp_path / "packed"), "--filter", "field=qcolor"])
    assert not (tmp_path / "packed" / "units.parquet").exists()
    main([str(store), "--rows", "field", "--units"])
    assert "spread, start" in capsys.readouterr().out
