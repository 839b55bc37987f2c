"""The search against a store whose runs are written in a moment: nothing is lost or tried twice, whatever kills it."""

import math
import random
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("optuna", reason='needs pip install "qnerf[search]"')

from qnerf.records import RunStore
from qnerf.search.history import History
from qnerf.search.loop import NoObjective, search
from qnerf.search.pruning import Judge
from qnerf.search.space import Choices, Interval, Point, Space
from qnerf.search.study import Options, Trial, best, importances, propose
from tests.helpers.stores import vanish

SPACE: Space = {
    "train.lr": Interval(1e-4, 1e-1, log=True),
    "layers": Choices.of(["3", "1", "2"]),
    "head": Choices.of(["mlp", "qiren"]),
}


def psnr_of(point: Point) -> float:
    return 20 - (math.log10(float(point[0])) + 2) ** 2 - int(point[1]) / 10


class Killed(BaseException):
    """What SIGKILL is to a process: nothing below runs any more."""


class Bench:
    """A search whose trainings are a formula. `deaths`: the moments, counted from 0, at which it is killed."""

    def __init__(
        self, store: Path, deaths: Sequence[int] = (), seeds: Sequence[int] = (0,), invalid: bool = True
    ) -> None:
        self.store = RunStore(store, every=60)
        self.invalid = invalid
        self.deaths, self.seeds = set(deaths), seeds
        self.moments = 0
        self.trained: Counter[str] = Counter()

    def moment(self) -> None:
        self.moments += 1
        if self.moments - 1 in self.deaths:
            raise Killed

    def ids(self, point: Point) -> list[str]:
        if self.invalid and point[1:] == ("3", "mlp"):
            raise ValueError("three layers are too many for an MLP")
        return [f"{'-'.join(point)}-s{seed}" for seed in self.seeds]

    def train(self, point: Point, seed: int, name: str) -> None:
        lr, layers, head = float(point[0]), int(point[1]), point[2]
        config = {"train": {"lr": lr}, "layers": layers, "head": head, "seed": seed}
        typed = [f"train.lr={lr}", f"layers={layers}", *([f"head={head}"] if head != "mlp" else [])]
        claim = self.store.claim(name, config, typed)
        if (run := claim.run) is None:
            return
        try:
            self.moment()
            if claim.outcome == "resumed":
                run.resume(0)
            if layers == 2 and head == "mlp":
                run.fail("it diverged")
                return
            psnr = psnr_of(point) + seed
            run.log(5, 1.0, {"eval/psnr": psnr - 1})
            self.moment()
            self.trained[name] += 1
            run.finish({"psnr": psnr, "params.total": 100 * layers})
        except Killed:
            vanish(run)
            raise
        self.moment()

    def launch(self, points: Sequence[Point], trials: Sequence[Trial]) -> None:
        for point in points:
            self.moment()
            for seed, name in zip(self.seeds, self.ids(point), strict=True):
                self.train(point, seed, name)

    def history(self, *objectives: str) -> History:
        return History(SPACE, objectives or ("psnr",), self.store.root, self.ids, {"head": "mlp"})

    def until_done(self, options: Options) -> list[Trial]:
        """Starts the search again after each death."""
        while True:
            try:
                return search(self.history(), options, self.launch)
            except Killed:
                pass


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.fsync", lambda _: None)


@pytest.mark.parametrize(("at_once", "seeds"), [(1, (0,)), (3, (0, 1))])
def test_a_search_that_is_killed_20_times_loses_and_repeats_nothing(tmp_path, at_once, seeds):
    moments = random.Random(at_once).sample(range(60), 20)
    options = Options(trials=14, at_once=at_once, startup=4)
    killed = Bench(tmp_path / "killed", moments, seeds, invalid=at_once > 1)
    trials = killed.until_done(options)
    assert killed.moments > max(moments), "each death happened"
    stored = [trial for trial in trials if trial.runs]
    assert len({trial.point for trial in stored}) == len(stored) == 14
    assert set(killed.trained.values()) == {1}, "no run was trained to its end twice"
    finished = {trial.point for trial in stored if trial.state == "finished"}
    assert {name for point in finished for name in killed.ids(point)} == set(killed.trained)
    assert {trial.state for trial in stored} == {"finished", "failed"}
    if at_once == 1:
        calm = Bench(tmp_path / "calm", (), seeds, invalid=False)
        assert trials == calm.until_done(options), "the deaths change nothing"
    again = search(killed.history(), options, killed.launch)
    assert [trial for trial in again if trial.runs] == stored


def test_two_processes_share_a_search(tmp_path, monkeypatch):
    """While one trains its first trial, the other trains the rest, and then waits for that one."""
    one, other = (Bench(tmp_path / "runs", invalid=False) for _ in range(2))

    def wait(seconds: float) -> None:
        raise Killed

    def meanwhile() -> None:
        one.moment = lambda: None  # type: ignore[method-assign]
        with pytest.raises(Killed):
            search(other.history(), Options(trials=5), other.launch)

    monkeypatch.setattr("time.sleep", wait)
    one.moment = lambda: meanwhile() if list(one.store.root.glob("*")) else None  # type: ignore[method-assign]
    trials = search(one.history(), Options(trials=5), one.launch)
    assert [trial.state == "unfinished" for trial in trials] == [False] * 5
    assert len(one.trained) == 1
    assert len(other.trained) == sum(trial.state == "finished" for trial in trials) - 1
    assert not one.trained & other.trained


def test_runs_of_a_sweep_count_and_a_finite_space_is_tried_once_and_to_its_end(tmp_path):
    bench = Bench(tmp_path / "runs")
    space: Space = {"layers": SPACE["layers"], "head": SPACE["head"]}

    def ids(point: Point) -> list[str]:
        return bench.ids(("0.01", *point))

    def launch(points: Sequence[Point], trials: Sequence[Trial]) -> None:
        bench.launch([("0.01", *point) for point in points], trials)

    bench.train(("0.01", "2", "qiren"), 0, ids(("2", "qiren"))[0])
    bench.train(("0.02", "1", "qiren"), 0, "0.02-1-qiren-s0")  # another learning rate is another search
    history = History(space, ("psnr",), bench.store.root, ids, {"head": "mlp"})
    assert [trial.point for trial in history.trials()] == [("2", "qiren")]
    trials = search(history, Options(trials=100, at_once=2), launch)
    assert Counter(trial.state for trial in trials) == {"finished": 4, "failed": 2}
    errors = {trial.point: trial.error for trial in trials if trial.error}
    assert errors == {("2", "mlp"): "it diverged", ("3", "mlp"): "three layers are too many for an MLP"}
    assert {trial.point[0] for trial in best(space, ["psnr"], trials)} == {"1"}
    assert set(bench.trained.values()) == {1}


def test_what_matters_is_known():
    """The best number of layers is 1."""
    space: Space = {"layers": SPACE["layers"], "head": SPACE["head"]}
    trials = [
        Trial((layers, head), "finished", (20.0 - int(layers),))
        for layers in "123"
        for head in ("mlp", "qiren")
        for _ in range(2)
    ]
    shares = importances(space, ["psnr"], trials)
    assert next(iter(shares)) == "layers"
    assert shares["layers"] > 0.8
    assert importances(space, ["psnr", "params.total"], trials) == {}


def test_a_search_finds_the_best_with_a_few_trials():
    """20 dB less 0.1 at 1 layer and a learning rate of 0.01; a random point loses 1.1 dB in the mean."""
    trials: list[Trial] = []
    for _ in range(16):
        (point,) = propose(SPACE, ["psnr"], trials, 1, Options(16))
        trials.append(Trial(point, "finished", (psnr_of(point),), ("run",)))
    assert best(SPACE, ["psnr"], trials)[0].values[0] > 19.8
    assert len(propose(SPACE, ["psnr"], trials[:6], 1, Options(16, sampler="gp"))) == 1


def test_an_objective_without_a_value_ends_the_search_after_the_first_finished_trial(tmp_path):
    bench = Bench(tmp_path / "runs", invalid=False)
    with pytest.raises(NoObjective, match="the run that has finished has no number for lpips"):
        search(bench.history("psnr", "lpips"), Options(trials=20), bench.launch)
    assert sum(bench.trained.values()) == 1


def test_several_objectives_give_a_front_without_a_beaten_trial(tmp_path):
    bench = Bench(tmp_path / "runs")
    objectives = ("psnr", "params.total")
    trials = search(bench.history(*objectives), Options(trials=12), bench.launch)
    finished = [trial for trial in trials if trial.state == "finished"]
    front = best(SPACE, objectives, trials)

    def beaten(trial: Trial) -> bool:
        psnr, size = trial.values
        return any(o.values[0] >= psnr and o.values[1] <= size and o.values != trial.values for o in finished)

    assert front
    assert {trial.point for trial in front} == {trial.point for trial in finished if not beaten(trial)}


def test_a_run_is_given_up_below_the_median_of_finished_runs(tmp_path):
    bench = Bench(tmp_path / "runs")
    points = [("0.01", "1", "qiren"), ("0.02", "1", "qiren"), ("0.03", "3", "qiren"), ("0.05", "3", "qiren")]
    bench.launch(points, [])
    peers = [bench.ids(point)[0] for point in points]
    path = bench.store.root / "new"
    judge = Judge(bench.store.root, "psnr", peers)
    claim = bench.store.claim("new", {}, columns={"params.total": 100})
    assert claim.run is not None
    assert not judge(path, 5, {"psnr": 19.0})
    assert judge(path, 5, {"psnr": 18.5})
    assert not Judge(bench.store.root, "psnr", peers, 25)(path, 5, {"psnr": 18.5}), "one of four is worse"
    assert not judge(path, 4, {"psnr": 17.0}), "nobody was evaluated after step 4"
    assert not judge(path, 5, {"psnr": None})
    assert not Judge(bench.store.root, "psnr", peers, warmup=6)(path, 5, {"psnr": 17.0})
    assert not Judge(bench.store.root, "psnr", peers[:3])(path, 5, {"psnr": 17.0}), "three are too few"
    claim.run.write_summary({"stopped": "pruned"})
    claim.run.interrupt()


@settings(max_examples=30)
@given(st.data())
def test_a_search_finds_its_draws_again_in_the_store(data):
    low, high = sorted(data.draw(st.tuples(st.floats(1e-6, 1e6), st.floats(1e-6, 1e6))))
    interval = Interval(low, high, log=data.draw(st.booleans()))
    text = interval.text(data.draw(st.floats(low, high)))
    assert low <= float(text) <= high
    assert interval.find(text) == text
    assert interval.text(interval.drawn(text)) == text
    values = data.draw(st.lists(st.one_of(st.integers(-9, 9), st.sampled_from(["a", "b"])), min_size=1, unique=True))
    choices = Choices.of(list(map(str, values)))
    assert {choices.find(str(value)) for value in values} == set(choices.texts)
    assert [choices.text(choices.drawn(text)) for text in choices.texts] == list(choices.texts)
    assert choices.find("c") is None


def test_a_search_makes_no_trial_of_a_proposal_alone():
    tried = [Trial(("0.01", layers, head), "finished", (1.0,)) for layers in "123" for head in ("mlp", "qiren")]
    points = propose({**SPACE, "train.lr": Interval(0.01, 0.01)}, ["psnr"], tried, 3, Options(9))
    assert points == []
    fresh = propose(SPACE, ["psnr"], tried, 30, Options(36))
    assert len(set(fresh)) == 30
