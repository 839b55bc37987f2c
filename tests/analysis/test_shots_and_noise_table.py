import shutil

import pandas as pd
import pytest
from qnerf.analysis import load
from qnerf.analysis.pack import main as pack
from qnerf.analysis.tables import shots_and_noise
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
    write_run(tmp_path / "runs", "classical", 0)
    return tmp_path / "runs"


def test_conditions_are_columns_exact_first_of_views_that_all_have(store):
    table = shots_and_noise(load.runs(store), ["field"])
    assert list(table.text) == ["field", "exact", "100 shots", "1,000 shots", "depolarizing 0.01", "seeds"]
    assert "| qcolor | 25.50 ± 0.71 | 18.00 ± 0.00 | 22.50 ± 0.71 | 20.00 (n = 1) | 2 |" in table.markdown()
    assert "left out: 1 not measured" in table.markdown()
    (row,) = table.data.to_dict("records")
    assert row["exact", "mean"] == pytest.approx(25.5)
    assert row["depolarizing 0.01", "count"] == 1


def test_packed_runs_tell_the_same(store, tmp_path):
    text = shots_and_noise(load.runs(store), ["field"]).markdown()
    pack([str(store), str(tmp_path / "packed")])
    shutil.rmtree(store)
    assert shots_and_noise(load.runs(tmp_path / "packed"), ["field"]).markdown() == text


def test_runs_that_nobody_measured_are_one_line(store, tmp_path, capsys):
    with pytest.raises(ValueError, match="no run was measured: qnerf probe RUN shots=100,1000"):
        shots_and_noise(load.runs(store, "field=classical"), ["field"])
    pack([str(store), str(tmp_path / "packed"), "--filter", "field=classical"])
    assert not (tmp_path / "packed" / "eval_hardware.parquet").exists()
    main([str(store), "--rows", "field", "--hardware"])
    assert "1,000 shots" in capsys.readouterr().out
