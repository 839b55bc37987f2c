import pandas as pd
import pytest
from qnerf.analysis import load
from qnerf.analysis.tables import ablation

from qnerf.records import RunStore, read_metrics
from tests.helpers.packed_stores import write_run


@pytest.fixture
def store(tmp_path):
    root = tmp_path / "runs"
    for seed, field in enumerate(["classical", "qcolor", "qcolor"]):
        scene = {"name": "nerfstudio", "path": "/data/fox"} if seed else {"name": "poster", "path": None}
        config = {"seed": seed, "scene": scene}
        run = RunStore(root).claim(f"r{seed}", config, columns={"field": field, "scene": scene["name"]}).run
        assert run is not None
        for step in range(3):
            run.log(step, 0.5 * step, {"loss": float(seed), "psnr": 20.0 + step})
        run.finish({"psnr": 20.0 + seed})
    return root


def test_load_gives_one_row_a_run(store):
    frame = load.runs(store)
    assert frame["run_id"].tolist() == ["r0", "r1", "r2"]
    assert frame["psnr"].tolist() == [20.0, 21.0, 22.0]
    assert frame["scene_name"].tolist() == ["poster", "fox", "fox"]
    assert frame["path"].tolist() == [str(store / name) for name in ("r0", "r1", "r2")]
    pd.testing.assert_frame_equal(load.runs(str(store)), frame)


def test_scenes_of_one_name_are_told_apart(tmp_path):
    """By their contents: folders may be called the same."""
    for seed in range(2):
        write_run(tmp_path, seed=seed, columns={"scene.fingerprint": "a"})
    write_run(tmp_path, seed=3, columns={"scene.fingerprint": "b"})
    with pytest.raises(ValueError, match=r"mixes runs of different scene\.fingerprint \(a, b\)"):
        ablation(load.runs(tmp_path), ["scene_name"])


def test_metrics_of_one_run(store):
    frame = load.metrics(store / "r1")
    pd.testing.assert_frame_equal(frame, read_metrics(store / "r1"))
    assert list(frame.columns) == ["step", "time_s", "key", "value"]
    psnr = load.metrics(str(store / "r1"), "psnr")
    assert psnr["value"].tolist() == [20.0, 21.0, 22.0]
    assert psnr.index.tolist() == [0, 1, 2]
    assert load.metrics(store / "r1", "absent").empty


def test_metrics_of_several_runs(store):
    frame = load.metrics(load.runs(store, {"field": "qcolor"}), "loss")
    assert list(frame.columns) == ["step", "time_s", "key", "value", "run_id"]
    assert frame.groupby("run_id")["value"].unique().map(list).to_dict() == {"r1": [1.0], "r2": [2.0]}


def test_metrics_that_are_damaged_or_absent_are_named(store):
    (store / "r1" / "metrics" / "part-00000.parquet").write_bytes(b"damaged")
    with pytest.raises(ValueError, match=r"r1/metrics/part-00000\.parquet: damaged"):
        load.metrics(store / "r1")
    with pytest.raises(ValueError, match="absent"):
        load.metrics(store / "absent")
