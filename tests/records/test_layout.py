"""The files of a run's folder, read by every reader."""

import json

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import yaml
from hypothesis import example, given, settings
from hypothesis import strategies as st
from omegaconf import OmegaConf
from PIL import Image

from qnerf import records
from qnerf.records import store
from tests.helpers.stores import CONFIG, claimed

TEXT = str(pd.Series(["text"]).dtype)
"""What pandas reads text as: `object` before pandas 3, `str` since."""


def test_a_new_run_is_complete_from_its_first_moment(store_):
    claim = store_.claim(
        "fox-1", CONFIG, ["seed=0", "train.lr=1e-6"], columns={"field": "qcolor", "time.field_ms": None}
    )
    assert (claim.outcome, claim.dir.name) == ("new", "fox-1")
    assert not claim.run.resumed
    assert (claim.dir / "overrides.txt").read_text() == "seed=0\ntrain.lr=1e-6\n"
    metrics = pd.read_parquet(claim.dir / "metrics")
    assert {k: str(v) for k, v in metrics.dtypes.items()} == {
        "step": "int64",
        "time_s": "float64",
        "key": TEXT,
        "value": "float64",
    }
    assert len(pd.read_parquet(claim.dir / "eval.parquet")) == 0
    row = pd.read_parquet(claim.dir / "summary.parquet").iloc[0]
    assert (row["run_id"], row["state"], row["field"]) == ("fox-1", "running", "qcolor")
    assert (row["seed"], row["train.lr"], row["odd"]) == (0, 1e-6, '["a", 1]')
    assert "hydra.x" not in row
    assert records.state(claim.dir) == "running"
    assert records.runs(store_.root) == [claim.dir]
    claim.run.finish()


def test_config_reads_back_the_same_with_every_reader(store_):
    run = claimed(store_)
    text = (run.dir / "config.yaml").read_text()
    assert records.read_config(run.dir) == CONFIG == yaml.safe_load(text)
    assert OmegaConf.to_container(OmegaConf.create(text)) == CONFIG
    run.interrupt()


@settings(max_examples=50)
@given(st.dictionaries(st.text(max_size=5), st.none() | st.booleans() | st.integers() | st.floats() | st.text()))
@example({"": "\x85", "a\x85b": "a\x85b"})
def test_any_text_and_number_survives_yaml(config):
    # repr, because nan differs from itself
    assert repr(yaml.safe_load(store.to_yaml(config))) == repr(config)


def test_evaluation_keeps_its_types(store_):
    run = claimed(store_)
    run.log(40, 1.0, {"loss": 1.0})
    rows = [{"image": "a.png", "psnr": 20, "lpips": None, "lpips_reason": "no weights", "view": 3}]
    run.write_eval([*rows, {"image": "b.png", "psnr": 21.5}])
    frame = pd.read_parquet(run.dir / "eval.parquet")
    assert frame["psnr"].tolist() == [20.0, 21.5]
    assert frame["step"].tolist() == [40, 40]
    assert {str(frame[name].dtype) for name in ("ssim", "lpips", "depth_error", "view")} == {"float64"}
    assert {str(frame[name].dtype) for name in ("image", "lpips_reason")} == {TEXT}
    with pytest.raises(ValueError, match="psnr: expected a number, got 'high'"):
        run.write_eval([{"image": "a.png", "psnr": "high"}])
    run.finish()
    assert len(pd.read_parquet(run.dir / "eval.parquet")) == 2


def test_summary_collects_and_keeps_its_types(store_):
    run = claimed(store_, columns={"field": "qcolor"})
    run.write_summary({"psnr": 20, "params.color": 211})
    run.interrupt()
    assert records.read_summary(run.dir)["state"] == "interrupted"
    run = claimed(store_)
    assert records.read_summary(run.dir)["state"] == "running"
    run.finish({"steps": 10, "time.field_ms": None, "step_ms": 24})
    row = records.read_summary(run.dir)
    assert (row["field"], row["psnr"], row["params.color"], row["steps"]) == ("qcolor", 20.0, 211, 10)
    assert row["state"] == "finished"


def test_summary_that_was_changed_since_is_read_from_the_file(store_):
    run = claimed(store_)
    run.finish({"psnr": 20.0, "params.color": 211})
    path = run.dir / "summary.parquet"
    table = pq.read_table(path)
    assert records.read_status(run.dir)["summary"]["row"] == table.to_pylist()[0]
    pq.write_table(table.set_column(table.schema.get_field_index("psnr"), "psnr", pa.array([21.0])), path)
    assert records.read_summary(run.dir)["psnr"] == 21.0


def test_environment_is_that_of_the_first_start(store_):
    run = claimed(store_)
    for environment, diff in (({"a": 1}, "x"), ({"a": 1}, "x"), ({"a": 2}, "")):
        run.write_environment(environment, diff)
    assert json.loads((run.dir / "environment.json").read_text()) == {"a": 1}
    assert (run.dir / "dirty.diff").read_text() == "x"
    assert (run.dir / "log.txt").read_text().endswith(" goes on in another environment: a=2\n")
    run.finish()


def test_pictures_and_lines_of_the_log_are_stored(store_):
    run = claimed(store_)
    picture = np.random.default_rng(0).integers(0, 255, (4, 5, 3), dtype=np.uint8)
    run.save_image("view_000", picture)
    assert np.array_equal(np.asarray(Image.open(run.dir / "images" / "view_000.png")), picture)
    for name in ("../x", "a/b", "", ".hidden"):
        with pytest.raises(ValueError, match="plain file name"):
            run.save_image(name, picture)
    with pytest.raises(ValueError, match=r"uint8, got \(4, 5, 3\) float64"):
        run.save_image("x", picture / 255)
    run.text_log("one\ntwo")
    assert (run.dir / "log.txt").read_text().endswith(" one two\n")
    run.finish()
