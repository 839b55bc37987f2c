"""`qnerf reproduce`: runs it again and compares the numbers and the environments."""

import json
from importlib.metadata import version

import numpy as np
import pandas as pd
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from qnerf import experiment, records
from qnerf.records.environment import differences
from qnerf.records.reproduction import compare, relative_difference

STEPS = ("train.steps=4", "train.eval_every=2")


@pytest.fixture(autouse=True)
def _no_checkout(monkeypatch):
    """The recorded environment does not depend on edits of this checkout during the tests."""
    monkeypatch.setattr("qnerf.records.environment.checkout", lambda: None)


@pytest.fixture
def run(tiny):
    return experiment.run(tiny(*STEPS, "field=qcolor")).path


@pytest.fixture
def reproduce(qnerf):
    """`reproduce(run, "--tolerance", 1e-3)`: exit code and output."""

    def call(run, *arguments):
        done = qnerf("reproduce", run.name, *arguments)
        return done.code, done.out + done.err

    return call


def change_metrics(run, change):
    part = run / "metrics" / "part-00000.parquet"
    change(pd.read_parquet(part)).to_parquet(part, index=False)


def scaled(rows, key, step, factor):
    return rows.assign(value=rows["value"].where((rows["key"] != key) | (rows["step"] < step), rows["value"] * factor))


def test_a_run_agrees_with_itself_bit_for_bit(run, reproduce):
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    code, output = reproduce(run)
    assert code == 0, output
    numbers = sum(item.numbers for item in compare(run, run))
    assert f"{run.name}: reproduced, {numbers:,} numbers agree bit for bit" in output
    assert {path: path.read_bytes() for path in run.rglob("*") if path.is_file()} == before
    assert records.runs(run.parent) == [run]


def test_reproduce_compares_these_tables(run):
    compared = {(item.table, item.name): item for item in compare(run, run)}
    logged = records.read_metrics(run)
    for key in ("train/loss", "train/psnr", "train/lr", "eval/psnr"):
        assert compared["metrics", key].numbers == (logged["key"] == key).sum()
    assert ("eval", "psnr") in compared
    assert {("summary", key) for key in ("psnr", "ssim", "steps", "params.total", "params.color")} <= compared.keys()
    clocks = [name for _, name in compared if "time" in name or name.endswith(("_s", "_ms", "_mb"))]
    assert clocks == []
    assert ("summary", "seed") not in compared  # an option, not a result


def test_numbers_and_environments_that_differ_are_named(run, reproduce):
    environment = json.loads((run / "environment.json").read_text())
    environment["packages"]["torch"] = "1.0"
    environment["git"] = {"commit": "c0ffee", "branch": "main", "dirty": True}
    (run / "environment.json").write_text(json.dumps(environment))
    change_metrics(run, lambda rows: scaled(rows, "train/loss", 3, 1.001))
    code, output = reproduce(run)
    assert code == 1
    lines = [line.split() for line in output.splitlines()]
    assert ["metrics", "train/loss", "4", "0", "0.000999", "step=3"] in lines
    assert ["packages.torch", "1.0", version("torch")] in lines
    assert "not reproduced, 1 of" in output
    assert "c0ffee" in output
    code, output = reproduce(run, "--tolerance", 0.01)
    assert code == 0
    assert "agree within 0.01; the largest relative difference is 0.000999" in output
    change_metrics(run, lambda rows: rows[(rows["key"] != "train/psnr") | (rows["step"] > 1)])
    code, output = reproduce(run, "--tolerance", 1e9)
    assert code == 1
    assert ["metrics", "train/psnr", "4", "1", "0", "step=1"] in [line.split() for line in output.splitlines()]


def test_the_threads_are_those_of_the_run(tiny, reproduce, monkeypatch):
    run = experiment.run(tiny(*STEPS, "threads=1")).path
    torch.set_num_threads(2)
    threads = []
    monkeypatch.setattr(torch, "set_num_threads", threads.append)
    reproduce(run)
    assert threads[0] == 1  # steps then switch between that and PyTorch's own


def test_differences_of_environments_leave_out_the_command():
    assert differences({"a": {"b": 1, "c": 2}, "command": [1]}, {"a": {"b": 1, "d": 3}, "command": [2]}) == {
        "a.c": (2, None),
        "a.d": (None, 3),
    }


numbers = st.floats() | st.sampled_from([0.0, -0.0, 1e-320, 1e308])


@given(numbers, numbers)
def test_the_relative_difference(a, b):
    forth, back = (
        relative_difference(np.array([a]), np.array([b]))[0],
        relative_difference(np.array([b]), np.array([a]))[0],
    )
    assert forth == back >= 0
    assert (forth == 0) == (a == b or (a != a and b != b))
    if np.isfinite(a) and np.isfinite(b):
        assert forth <= 2
    elif forth:
        assert forth == np.inf
