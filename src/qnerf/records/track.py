"""Tracks a training loop of the user's own as a run of the store, like those that qnerf trains."""

import contextlib
import os
import shlex
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from qnerf.config.checks import is_number
from qnerf.config.identity import clean, digest, leaves, plain
from qnerf.metrics import metric_of
from qnerf.records.checkpoints import load_archive
from qnerf.records.environment import capture, dirty_diff
from qnerf.records.files import StoreError
from qnerf.records.location import DEFAULT, store_folder
from qnerf.records.read import read_evaluation
from qnerf.records.schemas import NUMBERS, RESULT_GROUPS, check_result
from qnerf.records.store import RunStore
from qnerf.records.writer import Run

RESERVED = (*RESULT_GROUPS, "field", "hydra")
"""Names that mean something else in a store; a group of options that is called so is one of the group `train`."""

SYSTEM_EVERY = 10.0  # seconds between two rows of what the machine does

WHOLE = dict.fromkeys(NUMBERS, "int")
"""Options that are whole numbers in other runs, too. Any other number of a configuration is a float."""


@contextlib.contextmanager
def track(
    config: Mapping[str, Any],
    *,
    name: str,
    store: str | Path | None = None,
    force: bool = False,
    system: bool = False,
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
    in other runs. Another plain value is an option of the group `train`, such as `train.lr`, and so is a group with a
    name of ours, such as `train.params.lr`. name: what is trained, the column `field`. store: the folder of the runs;
    by default `runs`, or what `qnerf decide` says. force: a finished or interrupted run is done over. system: `log`
    adds, once in ten seconds, the cores that this process uses, its peak memory in MiB and the load of the machine.

    Raises:
        ValueError: the configuration holds something else than plain values, the store cannot be written, or another
            process writes the run.
    """
    grouped = _grouped(config)
    run_id = f"{clean(name)}-{digest(grouped, name)}"
    named = {**grouped, "field": name}
    folder = store_folder(store or os.environ.get("QNERF_STORE", DEFAULT)).absolute()
    if told := os.environ.get("QNERF_TRACKED"):  # qnerf decide, which started this process, finds the run by it
        Path(told).write_text(str(folder / run_id))
    claim = RunStore(folder).claim(run_id, named, types=WHOLE, force=force)
    if claim.outcome == "busy":
        ranks = "; of several ranks one tracks, and hands state and next_step to the others" if _is_ranked() else ""
        raise StoreError(claim.message + ranks)
    if claim.run is None:
        checkpoint = claim.dir / "checkpoint.pt"
        yield Tracked(claim.dir, None, load_archive(checkpoint) if checkpoint.exists() else None)
        return
    with claim.run as record:
        record.write_environment(capture(config.get("seed"), Path.cwd()), dirty_diff(Path.cwd()))
        tracked = Tracked(claim.dir, record, record.go_on(_check, by="seconds") if record.resumed else None, system)
        yield tracked
    if tracked.record is not None:
        tracked.record, tracked.closed = None, True


class Tracked:
    """What `track` gives.

    id, path: the run's name, and its folder. state: what was saved last, or None. next_step: the step to go on with.
    record: writes what else a run may have, such as `record.save_image(name, array)` and `record.write_eval(rows)`;
    None if the run is finished.
    """

    def __init__(
        self, path: Path, record: Run | None, checkpoint: Mapping[str, Any] | None, system: bool = False
    ) -> None:
        saved = checkpoint or {"step": 0, "seconds": 0.0, "state": None}
        self.id, self.path, self.record, self.state = path.name, path, record, saved["state"]
        self.closed = False
        self.next_step: int = saved["step"] + 1
        self._step: int = saved["step"]
        self._counts = False  # whether `steps` counts the steps
        self._logged = 0
        self._saved: float | None = None  # seconds at the save of this step
        self._start = time.perf_counter() - saved["seconds"]
        self._watch = (time.perf_counter(), time.process_time()) if system else None

    def __repr__(self) -> str:
        what = "finished" if self.record is None and not self.closed else f"step {self._step}"
        return f"<tracked run {self.id}, {what}, in {self.path.parent}>"

    @property
    def seconds(self) -> float:
        """Of training so far, those before the last save of an earlier process included."""
        return time.perf_counter() - self._start

    def steps(self, last: int) -> Iterator[int]:
        """The numbers of the steps that are left, from `next_step` to `last`; none if the run is finished.

        StoreError if the run has made more than `last` already.
        """
        if self.record is not None and self._step > last:
            raise StoreError(
                f"{self.path}: has made {self._step} steps, expected at most {last}; force=True does it over"
            )
        self._counts = True
        while self.record is not None and self._step < last:
            self._step, self._saved = self._step + 1, None
            yield self._step
        self._saved = None

    def log(self, step: int, values: Mapping[str, float] | None = None, /, **more: float) -> None:
        """One row of metrics for each value. step: the step of `steps`, or where the values stand on another axis, such
        as an epoch; only `steps` says where the run goes on.

        ValueError if the step is no whole number, a key no text or a value no number.
        """
        # A row after the save of its step is of that step, which will not be done again.
        seconds = self.seconds if self._saved is None else self._saved
        self._writer().log(
            step, seconds, {**(values or {}), **more, **self._system()}, done=self._step if self._counts else None
        )
        self._logged = int(step)

    def save(self, state: Any) -> None:
        """Saves tensors and plain values after the step of `steps`.

        ValueError for anything else, and in a loop that logs steps which `steps` does not count.
        """
        writer = self._writer()
        if self._logged and not self._counts:
            raise StoreError(
                f"{self.path}: save: expected `for step in run.steps(N)`, which says where the run goes on"
            )
        seconds = self.seconds
        writer.save_checkpoint({"step": self._step, "seconds": seconds, "state": state})
        self._saved = seconds

    def finish(self, results: Mapping[str, Any] | None = None, /, **more: Any) -> None:
        """The results of the run, columns of every table. Nothing if the run was finished before.

        Verdicts compare eval.parquet, one row a held-out image. If `record.write_eval` was not called, it gets one row.

        Raises:
            ValueError: a result has the name of an option or of another column, or is outside of the `with` block.
        """
        if self.record is None and not self.closed:
            return
        record = self._writer()
        measured = plain({**(results or {}), **more}, "summary")
        for key in measured:
            check_result(key, record.config)
        numbers = {key: value for key, value in measured.items() if is_number(value) and _is_quality(key)}
        if read_evaluation(self.path).empty:
            record.write_eval([{"image": "all", **numbers}])
        steps = self._step if self._counts else self._logged
        record.finish({"steps": steps, "train_s": self.seconds, **measured})
        self.record = None
        told = "".join(f", {metric_of(key).label} {metric_of(key).with_unit(value)}" for key, value in numbers.items())
        print(f"{self.id}: finished{told}; qnerf show {self.id} --store {shlex.quote(str(self.path.parent))}")

    def _system(self) -> dict[str, float]:
        """What this process and its machine were doing since the last call that said so."""
        if self._watch is None or (wall := time.perf_counter() - self._watch[0]) < SYSTEM_EVERY:
            return {}
        import torch

        from qnerf.timing import load, peak_memory_mb

        cores = (time.process_time() - self._watch[1]) / wall
        self._watch = time.perf_counter(), time.process_time()
        memory = peak_memory_mb(torch.device("cuda" if torch.cuda.is_available() else "cpu"))
        return {"system/cores": cores, "system/memory_mb": memory, "system/load": load()}

    def _writer(self) -> Run:
        if self.closed:
            raise StoreError(f"{self.path}: the `with` block of the run has ended, and the run with it")
        if self.record is None:
            raise StoreError(f"{self.path}: finished already; force=True does it over")
        return self.record


def _is_quality(key: str) -> bool:
    return metric_of(key).kind not in ("size", "time")


def _is_ranked() -> bool:
    """Whether this is one of several processes that a launcher such as torchrun has started together."""
    return any(os.environ.get(name, "1") != "1" for name in ("WORLD_SIZE", "OMPI_COMM_WORLD_SIZE", "SLURM_NTASKS"))


def _grouped(config: Mapping[str, Any]) -> dict[str, Any]:
    """The configuration with its plain values in the group `train`, and groups with names of our own.

    `scene` and `seed` stay outside. ValueError where two options have one name then.
    """
    own = {
        key: value
        for key, value in config.items()
        if key in ("scene", "seed") or (isinstance(value, Mapping) and key not in RESERVED)
    }
    train = {key: value for key, value in config.items() if key not in own}
    names = [name for name, _ in leaves(plain({**own, "train": {}}))]
    names += [f"train.{name}" for group in (own.get("train", {}), train) for name, _ in leaves(plain(group))]
    names += [name for name in train if name in names]  # as a dotted key, and in a group
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise ValueError(f"config: expected options of different names, got {twice[0]} twice")
    return own | {"train": {**own.get("train", {}), **train}} if train else own


def _check(checkpoint: Mapping[str, Any]) -> None:
    """ValueError if `Tracked.save` has not written it."""
    if checkpoint.keys() != {"step", "seconds", "state"} or not isinstance(checkpoint["step"], int):
        raise ValueError("expected a step and a state of a tracked run")
