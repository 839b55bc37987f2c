"""A loop that knows nothing of radiance fields is a run like the others."""

import contextlib
import multiprocessing
import re

import numpy as np
import pytest
import torch
from qnerf.analysis import load, selection
from qnerf.analysis.figures import points
from qnerf.analysis.report import content
from qnerf.analysis.selection import row_keys
from qnerf.analysis.tables import ablation

import qnerf
from qnerf import records
from qnerf.cli import main
from qnerf.cli.commands import diff
from qnerf.config.identity import flatten
from qnerf.records import StoreError

LAST = 12


def descent(rate, store, seed=0, stop=None):
    """Minimises the square of a number, x, and saves every fifth step; returns x by step. stop: it is killed there."""
    x, seen = torch.tensor(1.0 + seed), dict[int, float]()
    with qnerf.track(
        {"scene": "square", "seed": seed, "rate": rate, "steps": LAST}, name="descent", store=store
    ) as run:
        x = x if run.state is None else run.state["x"]
        for step in run.steps(LAST):
            x = x - 2 * rate * x
            seen[step] = x.item()
            run.log(step, {"train/loss": float(x**2)}, x=x.item())
            if step % 5 == 0:
                run.save({"x": x})
            if step == stop:
                raise KeyboardInterrupt
        run.finish(psnr=float(-10 * torch.log10(x**2)), **{"params.total": 1})
    return seen


def test_tracked_loop_goes_on_from_what_it_saved(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        descent(0.1, tmp_path, stop=8)
    (run,) = records.runs(tmp_path)
    assert records.state(run) == "interrupted"
    again, whole = descent(0.1, tmp_path), descent(0.1, tmp_path / "other")
    assert again == {step: whole[step] for step in range(6, LAST + 1)}  # bit for bit
    metrics = records.read_metrics(run)
    assert metrics["value"][metrics["key"] == "x"].tolist() == list(whole.values())
    assert metrics["time_s"].is_monotonic_increasing
    assert descent(0.1, tmp_path) == {}
    assert list(tmp_path.glob("descent*")) == [run]


def test_tracked_runs_stand_in_tables_beside_others(tmp_path, capsys):
    for rate in (0.1, 0.2):
        for seed in range(2):
            descent(rate, tmp_path, seed)
    frame = load.runs(tmp_path, "field=descent")
    assert frame["state"].tolist() == ["finished"] * 4
    assert (frame["seed"].dtype, frame["train.steps"].dtype) == ("int64", "int64")
    with pytest.raises(ValueError, match=r"mixes runs of different train\.rate"):
        ablation(frame, ["scene_name", "field"])
    assert ablation(frame, ["scene_name", "field", "train.rate"]).markdown().count("| square | descent |") == 2
    table = ablation(frame, ["train.rate"], baseline={"train.rate": 0.1}).markdown()
    assert "worse" in table or "better" in table
    run = records.runs(tmp_path)[0]
    for command in (["show", str(run)], ["runs", "--store", str(tmp_path)]):
        assert main.dispatch(command[0], command[1:]) == 0
    assert "descent" in capsys.readouterr().out
    assert main.dispatch("reproduce", [str(run)]) == 2
    assert "only that loop goes on with it" in capsys.readouterr().err


def test_tracked_run_has_one_writer_and_its_own_checkpoints(tmp_path):
    with qnerf.track({}, name="a", store=tmp_path) as run:
        assert run.record is not None
        run.record.save_checkpoint({"step": 1})
        with (
            pytest.raises(StoreError, match="already being written by process"),
            qnerf.track({}, name="a", store=tmp_path),
        ):
            pass
    with pytest.raises(StoreError, match="expected a step and a state"), qnerf.track({}, name="a", store=tmp_path):
        pass


@pytest.mark.parametrize("axis", ["epoch", "samples", "constant", "after the save"])
def test_the_loops_own_counter_alone_says_where_it_goes_on(tmp_path, axis):
    def loop(stop=None):
        made = []
        with qnerf.track({"scene": "demo"}, name="a", store=tmp_path) as run:
            for step in run.steps(20):
                made.append(step)
                run.log(step, loss=1 / step)
                place = {"epoch": step // 5, "samples": 32 * step, "constant": 0}.get(axis, step // 5)
                if step % 5 == 0:
                    if axis == "after the save":
                        run.save({"done": step})
                    run.log(place, {"val/loss": 0.5})
                    run.save({"done": step})
                if step == stop:
                    raise KeyboardInterrupt
            run.log(0, {"test/loss": 0.1})
            run.finish(psnr=20.0)
        return made

    with pytest.raises(KeyboardInterrupt):
        loop(stop=13)
    assert loop() == list(range(11, 21))
    (folder,) = records.runs(tmp_path)
    rows = records.read_metrics(folder)
    assert rows["key"].value_counts().to_dict() == {"loss": 20, "val/loss": 4, "test/loss": 1}
    assert rows["step"][rows["key"] == "loss"].tolist() == list(range(1, 21))
    assert records.read_summary(folder)["steps"] == 20


def test_rows_after_the_save_of_their_step_stay(tmp_path):
    for stop in (3, None):
        with contextlib.suppress(KeyboardInterrupt), qnerf.track({}, name="a", store=tmp_path) as run:
            for step in run.steps(4):
                run.save({})
                run.log(10 * step, x=step)
                if step == stop:
                    raise KeyboardInterrupt
            run.finish()
    assert records.read_metrics(run.path)["value"].tolist() == [1, 2, 3, 4]


def test_steps_go_on_where_the_loop_before_ended(tmp_path):
    with qnerf.track({}, name="a", store=tmp_path) as run:
        assert (list(run.steps(3)), list(run.steps(5))) == ([1, 2, 3], [4, 5])
        run.save({})
    with qnerf.track({}, name="a", store=tmp_path) as run, pytest.raises(StoreError, match="made 5 steps, expected at"):
        list(run.steps(4))


def test_a_loop_that_counts_by_itself_saves_nothing(tmp_path):
    with qnerf.track({}, name="a", store=tmp_path) as run:
        run.log(7, loss=1.0)
        with pytest.raises(StoreError, match=r"expected `for step in run\.steps\(N\)`"):
            run.save({})
        run.finish()
    assert records.read_summary(run.path)["steps"] == 7


@pytest.mark.parametrize("key", [None, 0, "", b"x", ("a",), "\udcff"])
def test_a_key_is_text(tmp_path, key):
    with qnerf.track({}, name="a", store=tmp_path) as run:
        run.log(1, good=1.0)
        with pytest.raises(ValueError, match="log: expected text as a key"):
            run.log(1, {key: 1.0})
        with pytest.raises(ValueError, match=r"log: expected a whole number as the step, got 1\.5"):
            run.log(1.5, loss=1.0)
        if not isinstance(key, (int, str)) or key == "\udcff":
            with pytest.raises(ValueError, match="summary: expected keys of text, each once"):
                run.finish({key: 1.0})
    assert records.read_metrics(run.path)["key"].tolist() == ["good"]


def test_a_fork_writes_nothing_and_says_so(tmp_path):
    context = multiprocessing.get_context("fork")
    with qnerf.track({}, name="a", store=tmp_path) as run:
        for step in run.steps(2):
            run.log(step, x=1.0)
            queue = context.SimpleQueue()
            process = context.Process(target=_in_fork, args=(run, queue))
            process.start()
            said = queue.get()
            process.join()
            assert len(said) == 3
            assert all(re.search(r"process \d+ writes the run, and process \d+ is a fork", line) for line in said)
        run.finish(psnr=1.0)
    assert len(records.read_metrics(run.path)) == 2
    assert records.state(run.path) == "finished"


def _in_fork(run, queue):
    said = []
    for act in (lambda: run.log(1, x=2.0), lambda: run.save({}), lambda: run.finish(psnr=2.0)):
        try:
            act()
        except StoreError as error:
            said.append(str(error))
    if run.record is not None:
        run.record.__exit__(None, None, None)  # as at the end of the block
    queue.put(said)


def test_a_second_rank_is_told_that_one_tracks(tmp_path, monkeypatch):
    monkeypatch.setenv("WORLD_SIZE", "2")
    with (
        qnerf.track({}, name="a", store=tmp_path),
        pytest.raises(StoreError, match=r"being written by process .*of several ranks one tracks"),
        qnerf.track({}, name="a", store=tmp_path),
    ):
        pass


def test_the_block_is_the_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "other").mkdir()
    with qnerf.track({}, name="a", store="runs") as run:
        monkeypatch.chdir(tmp_path / "other")
        run.log(1, x=1.0)
    for act in (lambda: run.finish(psnr=1.0), lambda: run.log(1, x=1.0), lambda: run.save({})):
        with pytest.raises(StoreError, match="the `with` block of the run has ended"):
            act()
    assert records.read_metrics(tmp_path / "runs" / run.path.name)["value"].tolist() == [1.0]
    assert not list((tmp_path / "other").iterdir())


GROUPS = [{name: {"lr": 0.1}} for name in ("params", "time", "run", "cost", "field", "hydra", "model", "psnr", "_own")]
PLAIN = [
    {name: 0.1} for name in ("params", "time", "run", "cost", "field", "psnr", "name", "eval_every", "_own", "a.b")
]


@pytest.mark.parametrize("config", [*GROUPS, *PLAIN], ids=str)
def test_every_name_of_an_option_tells_runs_apart(tmp_path, config):
    (name,) = config
    other = {name: {"lr": 2}} if isinstance(config[name], dict) else {name: 2}
    for options, psnr in ((config, 20.0), (other, 30.0)):
        for seed in (0, 1):
            with qnerf.track({"scene": "s", "seed": seed, **options}, name="m", store=tmp_path) as run:
                run.finish(psnr=psnr + seed)
    frame = load.runs(tmp_path)
    with pytest.raises(ValueError, match=f"mixes runs of different .*{name}"):
        ablation(frame, ["scene_name", "field"])
    assert points.points(frame, ["psnr"])["psnr"].tolist() == [30.5, 20.5]
    rows = row_keys(frame)
    assert len(ablation(frame, rows).text) == 2
    assert content.named(content.described(frame))["configuration"].nunique() == 2


@pytest.mark.parametrize("config", [{"scene": "s"}, {}])
def test_a_name_alone_tells_runs_apart(tmp_path, config):
    for name, psnr in (("_one", 20.0), ("two", 30.0)):
        for seed in (0, 1):
            with qnerf.track({**config, "seed": seed}, name=name, store=tmp_path) as run:
                run.finish(psnr=psnr + seed)
    frame = load.runs(tmp_path)
    assert points.points(frame, ["psnr"])["name"].tolist() == ["two", "_one"]
    assert ablation(frame, ["scene_name", "field"]).text["field"].tolist() == ["_one", "two"]
    assert set(content.named(content.described(frame))["configuration"]) == {"_one", "two"}
    differing = diff.differences(*(flatten(records.read_config(run)) for run in records.runs(tmp_path)[1:3]))
    assert differing["field"] == ["_one", "two", None]


@pytest.mark.parametrize(
    ("results", "message"),
    [
        ({"seed": 3}, "seed: is the name of an option"),
        ({"train.lr": 3}, "train.lr: is the name of an option"),
        ({"state": "good"}, "state: is the name of an option or of the run's own column"),
        ({"val.loss": 3}, "val.loss: dots are for options; expected a result such as val/loss"),
    ],
)
def test_a_result_has_a_name_of_its_own(tmp_path, results, message):
    with qnerf.track({"lr": 0.1}, name="a", store=tmp_path) as run:
        with pytest.raises(ValueError, match=message):
            run.finish(results)
        run.finish(psnr=1.0)
    assert records.read_summary(run.path)["psnr"] == 1.0


def test_two_options_of_one_name_are_refused(tmp_path):
    for config in (
        {"train.lr": 0.1, "train": {"lr": 0.2}},
        {"lr": 0.1, "train": {"lr": 0.2}},
        {"opt.lr": 0.1, "opt": {"lr": 0.1}},
    ):
        with pytest.raises(ValueError, match=r"\.lr twice"), qnerf.track(config, name="a", store=tmp_path):
            pass
    assert not records.runs(tmp_path)


def test_numbers_may_be_numpy_s_and_pytorch_s_but_a_seed_is_whole(tmp_path):
    for seed in ("x", 1.5):
        with (
            pytest.raises(ValueError, match="seed: expected a whole number, got"),
            qnerf.track({"seed": seed}, name="a", store=tmp_path),
        ):
            pass
    assert not records.runs(tmp_path)
    with qnerf.track({"seed": np.int64(1)}, name="a", store=tmp_path) as run:
        run.log(1, loss=torch.ones((), requires_grad=True))
        run.finish(psnr=torch.tensor(20.0), ssim=np.float32(0.5))
        with pytest.raises(StoreError, match="finished already"):
            run.log(2, loss=1.0)
    assert (records.read_summary(run.path)["psnr"], records.read_summary(run.path)["seed"]) == (20.0, 1)
    assert qnerf.load("a-", store=tmp_path).eval()["ssim"].tolist() == [0.5]


def test_a_run_says_who_it_is_and_what_to_type_next(tmp_path, capsys):
    with qnerf.track({"seed": 0}, name="mine", store=tmp_path) as run:
        assert repr(run) == f"<tracked run {run.id}, step 0, in {tmp_path}>"
        run.finish(accuracy=93.25, mse=0.5, params={"total": 12})
    results = "accuracy 93.25, mean squared error 0.50000"
    assert capsys.readouterr().out == f"{run.id}: finished, {results}; qnerf show {run.id} --store {tmp_path}\n"
    assert main.dispatch("show", [run.id, "--store", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert "0 steps  started" in said
    assert "held out   accuracy 93.25   mean squared error 0.50000" in said
    assert "all       93.25" in said
    assert selection.main_metric(load.runs(tmp_path)) == "accuracy"


def test_what_the_machine_does_is_logged_if_asked_for(tmp_path, monkeypatch):
    monkeypatch.setattr("qnerf.records.track.SYSTEM_EVERY", 0.0)
    for system in (False, True):
        with qnerf.track({"seed": int(system)}, name="mine", store=tmp_path, system=system) as run:
            run.log(1, loss=0.5)
        logged = set(records.read_metrics(run.path)["key"])
        assert logged == {"loss"} | {f"system/{key}" for key in ("cores", "memory_mb", "load") if system}
