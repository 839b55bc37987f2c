"""Runs that train side by side end as they would alone, each in its own folder."""

from typing import Any

import numpy as np
import torch

from qnerf.building.scene import prepare
from qnerf.experiment import Display, Job, Outcome, run, side_by_side
from qnerf.records import read_metrics, read_summary, state
from tests.helpers.configs import MOMENT
from tests.helpers.stopping import At
from tests.helpers.trainer import same

SHORT = (*MOMENT, "train.steps=8", "train.eval_every=4", "appearance=2", "cameras=so3xr3")


def job(config: Any, display: Display | None = None) -> Job:
    prepared = prepare(config)
    return Job(prepared, (), display or Display(), prepared.find_id(prepared.settings.store))


def learnt(outcome: Any) -> dict[str, Any]:
    kept: dict[str, Any] = torch.load(outcome.path / "checkpoint.pt", weights_only=True)
    del kept["step_seconds"]
    logged = read_metrics(outcome.path)
    logged = logged[~logged["key"].str.startswith("time/")]
    return kept | {"logged": torch.tensor(np.array(logged[["step", "value"]]))}


def finished(outcome: Outcome | Exception) -> Outcome:
    assert isinstance(outcome, Outcome), outcome
    assert outcome.state == "finished"
    return outcome


def test_they_compute_what_they_compute_alone(tiny: Any, tmp_path: Any) -> None:
    options = [(*SHORT, "field=qcolor", f"seed={seed}") for seed in (0, 1)] + [(*SHORT, "field=classical")]
    alone = [run(tiny(*one, f"store={tmp_path / 'alone'}")) for one in options]
    beside = side_by_side([job(tiny(*one, f"store={tmp_path / 'beside'}")) for one in options])
    for one, other in zip(alone, map(finished, beside), strict=True):
        assert one.run_id == other.run_id
        assert same(learnt(one), learnt(other))
        assert (read_summary(one.path)["time.beside"], read_summary(other.path)["time.beside"]) == (1, 3)


def test_one_that_fails_ends_alone_and_a_stop_ends_all(tiny: Any, tmp_path: Any) -> None:
    def fail() -> None:
        raise ValueError("of one")

    class Stops(Display):
        steps = 0

        def step(self, step: int, metrics: Any) -> None:
            Stops.steps += step == 4

        def stopping(self) -> bool:
            return Stops.steps == 2

    configs = [tiny(*SHORT, "field=classical", f"seed={seed}", f"store={tmp_path}") for seed in range(3)]
    error, *stopped = side_by_side([job(configs[0], At(2, fail)), *(job(config, Stops()) for config in configs[1:])])
    assert str(error) == "of one"
    assert [one.state for one in stopped if isinstance(one, Outcome)] == ["interrupted"] * 2
    for outcome in side_by_side([job(config) for config in configs]):
        finished(outcome)


def test_a_signal_interrupts_all_of_them(tiny: Any, tmp_path: Any) -> None:
    def interrupt() -> None:
        raise KeyboardInterrupt

    configs = [tiny(*SHORT, "field=classical", f"seed={seed}", f"store={tmp_path}") for seed in range(2)]
    jobs = [job(configs[0], At(3, interrupt)), job(configs[1])]
    try:
        side_by_side(jobs)
    except KeyboardInterrupt:
        assert [state(tmp_path / one.name) for one in jobs] == ["interrupted"] * 2
    else:
        raise AssertionError("not interrupted")
