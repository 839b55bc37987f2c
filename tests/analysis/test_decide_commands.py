"""A study of a user's own program: each seed is one process, whose tracked run is the result."""

import runpy
import sys
import time
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import pandas as pd
import pytest
from qnerf.analysis.decide import __main__ as decide
from qnerf.analysis.decide import commands, study
from qnerf.analysis.decide.records import records

from qnerf.records import owner
from qnerf.records import runs as folders
from tests.helpers.configs import ROOT

PROGRAM = """
import os, sys
import qnerf
seed, mistakes = int(os.environ["QNERF_SEED"]), sys.argv[1:]
if "fails" in mistakes:
    sys.exit(3)
if "tracks-nothing" not in mistakes:
    config = {"scene": "digits", "model": "b" if "b" in mistakes else "a"}
    if "no-seed" not in mistakes:
        config["seed"] = seed
    with qnerf.track(config, name="mine", store="else" if "elsewhere" in mistakes else None) as run:
        if "never-finishes" not in mistakes:
            run.finish(accuracy=90.0 + seed, loss=0.5)
"""


@pytest.fixture
def begun(monkeypatch, tmp_path):
    """The seeds of the processes that were started; they run in this one. A callable among `stops` comes before one."""
    seeds, stops = [], []

    @contextmanager
    def here(command, env):
        def wait():
            if stops:
                stops.pop()()
            try:
                runpy.run_path(command[1], run_name="__main__")
            except SystemExit as error:
                return error.code
            return 0

        with monkeypatch.context() as patched:
            for key in ("QNERF_SEED", "QNERF_STORE", "QNERF_TRACKED"):
                patched.setenv(key, env[key])
            patched.setattr(sys, "argv", command[1:])
            seeds.append(int(env["QNERF_SEED"]))
            yield SimpleNamespace(wait=wait)

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(commands, "child", here)
    (tmp_path / "mine.py").write_text(PROGRAM)
    return SimpleNamespace(seeds=seeds, stops=stops)


def stop():
    raise KeyboardInterrupt


def test_a_study_of_commands_stops_and_goes_on_to_its_verdict(begun, tmp_path, capsys):
    program = ROOT / "examples" / "tracked.py"
    asked = [f"python {program} --width {width} --steps 200" for width in (2, 32)]
    begun.stops += [stop, list, list]
    with pytest.raises(KeyboardInterrupt):
        decide.main(asked)
    assert begun.seeds == [0, 1, 0]
    decide.main(asked)
    assert begun.seeds == [0, 1, 0, 0, 1, 2, 3, 4, 5, 2, 3, 4, 5]
    assert records("runs")["verdict"].str.split(";").str[0].tolist() == ["better"]
    assert records("runs")[["candidate", "baseline"]].to_numpy().tolist() == [["--width 32", "--width 2"]]
    assert study.found(asked[0].split(), range(6), Path("runs"))["train_s"].gt(0).all()
    frame = pd.concat([pd.read_parquet(run / "summary.parquet") for run in folders("runs")])
    assert sorted(zip(frame["train.width"], frame["seed"], strict=True)) == [(w, s) for w in (2, 32) for s in range(6)]
    decide.main(asked)
    assert len(begun.seeds) == 13
    assert "psnr: higher is better" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("fails", "python mine.py fails, seed 0: ended with exit code 3"),
        ("tracks-nothing", "python mine.py tracks-nothing, seed 0: left no run in runs; expected `with qnerf.track"),
        ("elsewhere", "left no run in runs; .* without store="),
        ("never-finishes", r"left its run interrupted; expected `run.finish\(...\)` with the metric"),
        ("no-seed", "^mine-[0-9a-f]*: stands for several runs; its config lacks the seed, or what tells"),
        ("--metric recall", "no recall; choose another --metric: train_s, steps, accuracy, loss"),
        ("--tune 3", "--tune, --space and --equal time: expected candidates of `qnerf run`"),
    ],
)
def test_what_is_wrong_with_a_program_shows_in_its_first_runs(begun, words, message):
    first, _, option = words.partition("--")
    asked = [f"python mine.py {first}".strip(), "python mine.py b", "--metric", "accuracy", "--within", "1"]
    with pytest.raises(ValueError, match=message):
        decide.main([*asked, *f"--{option}".split()] if option else asked)
    assert len(begun.seeds) <= 2


def test_candidates_of_two_kinds_and_words_that_start_nothing(tmp_path):
    for other in ("field=qcolor", "nowhere.py a"):
        asked = ["nowhere.py b", other, "--metric", "accuracy", "--within", "1", "--store", str(tmp_path)]
        with pytest.raises(ValueError, match=r"field=qcolor: expected a command|nowhere.py b, seed 0: No such file"):
            decide.main(asked)


def test_two_shells_share_the_seeds(begun, tmp_path, monkeypatch):
    """A seed that another process trains is left to it; the study waits for the last one."""
    words, store = ["python", "mine.py"], tmp_path / "runs"
    folder = commands.run_of(words, 0, store).parent
    folder.mkdir(parents=True)
    other, waited = owner.acquire(folder), []

    def sleep(seconds):
        waited.append(list(begun.seeds))
        other.release()

    monkeypatch.setattr(commands, "time", SimpleNamespace(sleep=sleep, monotonic=time.monotonic))
    commands.train(words, [0, 1, 2], store, float)
    assert (waited, begun.seeds) == ([[1, 2]], [1, 2, 0])


def test_a_metric_whose_name_says_error_is_better_low(begun, capsys):
    with pytest.raises(ValueError, match="no val_loss"):
        decide.main(["python mine.py", "python mine.py b", "--metric", "val_loss", "--within", "1"])
    assert "val_loss: lower is better" in capsys.readouterr().out
