"""Types are declared: a store of unlike runs opens with every reader, without casts."""

from pathlib import Path

import pandas as pd
import pyarrow as pa
import pyarrow.dataset as ds
import pyarrow.parquet as pq
import pytest

from qnerf.records import RunStore, read_summary

RUNS = {
    "poster": ({"seed": 0, "train": {"lr": 1, "width": None}, "scene": {"name": "poster"}}, {"psnr": 20, "ssim": None}),
    "photos": (
        {"seed": 1, "train": {"lr": 0.5, "width": 36}, "scene": {"name": "nerfstudio", "box": [1, 2.5], "crop": True}},
        {"lpips_reason": "no weights", "eval_views": 3, "params.color": 211, "machine": "a"},
    ),
    "signal": ({"seed": 2, "train": {"lr": 3}, "extra": {"count": 2}}, {"psnr_unseen": 7, "stopped": None, "more": 1}),
    "later": ({"seed": 3, "train": {"lr": 2}, "extra": {"count": 0.5}}, {"stopped": "plateau", "more": 0.5}),
}
TYPES = {"seed": "int", "train.lr": "float", "train.width": "int", "scene.name": "text", "scene.box": "text"}


@pytest.fixture
def store(tmp_path):
    store = RunStore(tmp_path / "runs")
    for name, (config, results) in RUNS.items():
        run = store.claim(name, config, types=TYPES).run
        assert run is not None
        run.log(1, 0.5, {"train/loss": 1})
        extra = {} if name == "signal" else {"ssim": 1}
        run.write_eval([{"image": name, "psnr": 3} | extra])
        run.finish(results)
    return store.root


def test_summaries_have_one_schema(store):
    schemas = [pq.read_schema(store / name / "summary.parquet") for name in RUNS]
    schema = pa.unify_schemas(schemas)
    declared = {"int": "int64", "float": "double", "bool": "bool", "text": "string"}
    results = {"psnr": "float", "params.color": "int", "lpips_reason": "text", "error": "text", "more": "float"}
    for name, kind in {**TYPES, **results, "extra.count": "float", "scene.crop": "bool"}.items():
        assert str(schema.field(name).type) == declared[kind]
    assert not any(pa.types.is_null(kind) for schema in schemas for kind in schema.types)
    assert "train.width" in schemas[0].names  # declared, without a value
    assert "stopped" in schemas[2].names
    assert read_summary(store / "signal")["train.lr"] == 3.0


def test_store_opens_with_pyarrow_and_pandas(store):
    files = [str(store / name / "summary.parquet") for name in RUNS]
    schema = pa.unify_schemas([pq.read_schema(file) for file in files])
    assert ds.dataset(files, schema=schema).to_table(use_threads=False)["train.lr"].to_pylist() == [1, 0.5, 3, 2]
    assert ds.dataset(files).to_table(use_threads=False).num_rows == 4
    for file in ("eval.parquet", "metrics/part-00000.parquet"):
        assert ds.dataset([str(store / name / file) for name in RUNS]).to_table(use_threads=False).num_rows == 4
    joined = pd.concat(map(pd.read_parquet, files))
    assert joined["seed"].tolist() == [0, 1, 2, 3]


def test_store_is_written_and_read_as_documented(store, monkeypatch):
    monkeypatch.chdir(store.parent)
    page = (Path(__file__).parents[2] / "docs" / "runs.md").read_text()
    for section in ("Track a loop of your own", "Track a loop of your own", "Read the files yourself"):
        code = page.partition(f"## {section}\n")[2].partition("```python\n")[2].partition("```")[0]
        exec(compile(code, section, "exec"), {})


@pytest.mark.parametrize("value", ["fast", True])
def test_option_of_another_type_is_refused(tmp_path, value):
    with pytest.raises(ValueError, match=r"train\.lr: expected a number, got"):
        RunStore(tmp_path).claim("a", {"train": {"lr": value}}, types=TYPES)
    assert not (tmp_path / "a").exists()
