"""Tracks a training loop of the user's own as a run of the store, like those that qnerf trains."""

import contextlib
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from qnerf.config.checks import is_number
from qnerf.config.identity import clean, digest, plain
from qnerf.metrics import metric_of
from qnerf.records.checkpoints import load_archive
from qnerf.records.environment import capture, dirty_diff
from qnerf.records.files import StoreError
from qnerf.records.location import DEFAULT
from qnerf.records.read import read_evaluation
from qnerf.records.store import RunStore
from qnerf.records.writer import Run

WHOLE = {"seed": "int", "train.steps": "int"}
"""Options that are whole numbers in other runs, too. Any other number of a configuration is a float."""


@contextlib.contextmanager
def track(
    config: Mapping[str, Any], *, name: str, store: str | Path = DEFAULT, force: bool = False
) -> "Iterator[Tracked]":
    """A run that logs, saves and resumes a loop of your own::

        with qnerf.track({"scene": "digits", "seed": 0, "lr": 1e-3}, name="mine") as run:
            if run.state is not None:
                model.load_state_dict(run.state)
            for step in run.steps(1000):
                run.log(step, loss=train(model))
                if step % 100 == 0:
                    run.save(model.state_dict())
            run.finish(psnr=evaluate(model))

    The run's id is the name and a hash of the configuration. The same call continues an interrupted run from what was
    saved last; it makes no step if the run is finished.

    config: nested plain values, which become columns of the run in every table. `scene` and `seed` mean what they mean
    in other runs; another plain value is an option of the group `train`, such as `train.lr`. name: what is trained, the
    column `field`. store: the folder of the runs. force: a finished or interrupted run is done over.

    Raises:
        ValueError: the configuration holds something else than plain values, the store cannot be written, or another
            process writes the run.
    """
    grouped = _grouped(config)
    run_id = f"{clean(name)}-{digest(grouped, name)}"
    claim = RunStore(store).claim(run_id, grouped, columns={"field": name}, types=WHOLE, force=force)
    if claim.outcome == "busy":
        raise StoreError(claim.message)
    if claim.run is None:
        checkpoint = claim.dir / "checkpoint.pt"
        yield Tracked(claim.dir, None, load_archive(checkpoint) if checkpoint.exists() else None)
        return
    with claim.run as record:
        record.write_environment(capture(config.get("seed"), Path.cwd()), dirty_diff(Path.cwd()))
        yield Tracked(claim.dir, record, record.go_on(_check) if record.resumed else None)


class Tracked:
    """What `track` gives.

    path: the run's folder. state: what was saved last, or None. next_step: the step to go on with. record: writes what
    else a run may have, such as `record.save_image(name, array)` and `record.write_eval(rows)`; None if the run is
    finished.
    """

    def __init__(self, path: Path, record: Run | None, checkpoint: Mapping[str, Any] | None) -> None:
        saved = checkpoint or {"step": 0, "seconds": 0.0, "state": None}
        self.path, self.record, self.state = path, record, saved["state"]
        self.next_step: int = saved["step"] + 1
        self._step: int = saved["step"]
        self._start = time.perf_counter() - saved["seconds"]

    @property
    def seconds(self) -> float:
        """Of training so far, those before the last save of an earlier process included."""
        return time.perf_counter() - self._start

    def steps(self, last: int) -> Iterator[int]:
        """The numbers of the steps that are left, from `next_step` to `last`; none if the run is finished."""
        for step in range(self.next_step, last + 1 if self.record else 0):
            self._step = step
            yield step

    def log(self, step: int, values: Mapping[str, float] | None = None, /, **more: float) -> None:
        """One row of metrics for each value; ValueError if one is not a number."""
        self._step = step
        self._writer().log(step, self.seconds, {**(values or {}), **more})

    def save(self, state: Any) -> None:
        """Saves tensors and plain values after the step of `steps` or `log`; ValueError for anything else."""
        self._writer().save_checkpoint({"step": self._step, "seconds": self.seconds, "state": state})

    def finish(self, results: Mapping[str, Any] | None = None, /, **more: Any) -> None:
        """The results of the run, columns of every table. Nothing if the run was finished before.

        Verdicts compare eval.parquet, one row a held-out image. If `record.write_eval` was not called, it gets one row.
        """
        if self.record is None:
            return
        measured = plain({**(results or {}), **more}, "summary")
        if read_evaluation(self.path).empty:
            numbers = {key: value for key, value in measured.items() if is_number(value) and _is_quality(key)}
            self.record.write_eval([{"image": "all", **numbers}])
        self.record.finish({"steps": self._step, "train_s": self.seconds, **measured})
        self.record = None

    def _writer(self) -> Run:
        if self.record is None:
            raise StoreError(f"{self.path}: finished already; force=True does it over")
        return self.record


def _is_quality(key: str) -> bool:
    return metric_of(key).kind not in ("size", "time")


def _grouped(config: Mapping[str, Any]) -> dict[str, Any]:
    """The configuration with its plain values in the group `train`; `scene` and `seed` stay outside."""
    own = {key: value for key, value in config.items() if key in ("scene", "seed") or isinstance(value, Mapping)}
    train = {key: value for key, value in config.items() if key not in own}
    return own | {"train": {**own.get("train", {}), **train}} if train else own


def _check(checkpoint: Mapping[str, Any]) -> None:
    """ValueError if `Tracked.save` has not written it."""
    if checkpoint.keys() != {"step", "seconds", "state"} or not isinstance(checkpoint["step"], int):
        raise ValueError("expected a step and a state of a tracked run")
