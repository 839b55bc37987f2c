"""One run, top to bottom: scene -> rays -> samples -> field -> render -> loss -> metrics -> parquet."""

import contextlib
import math
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from qnerf import auto
from qnerf.building.configuration import Configuration
from qnerf.building.model import parameter_counts
from qnerf.building.scene import Prepared, prepare
from qnerf.config import devices
from qnerf.config.checks import is_number
from qnerf.config.identity import picture_names
from qnerf.kernels import dispatch
from qnerf.metrics import COLORLESS, quality_metrics
from qnerf.model.labels import labels
from qnerf.quantum import QuantumLayer
from qnerf.records import Run, RunStore, StoreError, read_config, read_metrics, read_summary, state
from qnerf.records.environment import capture, dirty_diff
from qnerf.records.schemas import RECORDED
from qnerf.scenes.base import even_subset
from qnerf.timing import STAGES, Stopwatch, machine, median_ms, peak_memory_mb
from qnerf.training.forecast import FORWARD, foretold, seconds_of_circuits
from qnerf.training.preview import Preview
from qnerf.training.stop_requests import stop_requests
from qnerf.training.stopping import PLATEAU, PRUNED
from qnerf.training.task import Measures, Task, ViewEvaluator
from qnerf.training.turns import Turns

SHARE, FEWEST = 0.05, 2**14  # of the training's time that its curves take, unless a curve has fewer rays a point
WORTH_A_MENTION = 60.0  # seconds of the evaluation after the last step
EARLY = 300  # steps that a model may take to learn more than the mean colour
SLOW, LONG = 1.0, 10.0  # seconds of a step: each one is saved; it is foretold, and there are no previews


@dataclass(frozen=True)
class Outcome:
    """How a command ended: `state` is finished, interrupted, pruned, or busy (another process writes the run)."""

    run_id: str
    path: Path
    state: str
    summary: dict[str, Any]
    message: str


class Display:
    """Receives the progress of a run, and may stop it. This one is silent; the command line has one that prints."""

    def describe(self, config: Mapping[str, Any], parameters: Mapping[str, int]) -> None:
        """Before `begin`: the configuration that acts, and the number of parameters of each part of the model."""

    def begin(self, path: Path, step: int, steps: int) -> None: ...

    def phase(self, name: str) -> None:
        """What the run does from now on: train or evaluate. Between `begin` and the first step it compiles."""

    def step(self, step: int, metrics: Mapping[str, float]) -> None: ...

    def held_out(self, step: int, metric: str, value: float | str | None, views: str) -> None:
        """The mean of a metric over held-out views; `views` says which, `4 of 22 views`, the same ones throughout.

        A signal, which has no views, has an empty text.
        """

    def note(self, text: str) -> None: ...

    def stopping(self) -> bool:
        """Asked before every step. Once it is true, the run stops with a checkpoint, as on a signal."""
        return False

    def unpromising(self, path: Path, step: int, measured: Measures) -> bool:
        """Asked after every evaluation but the last, with the run's folder and the means.

        If it is true, the run is pruned: it stops with a checkpoint, its summary says so (`stopped`), and a search does
        not continue it. Everybody else may.
        """
        return False

    def end(self) -> None: ...


@dataclass(frozen=True)
class Job:
    """A run that is asked for: its configuration with the scene, what the user typed, and the run's id."""

    prepared: Prepared
    overrides: Sequence[str]
    display: Display
    name: str

    @property
    def device(self) -> str:
        return str(self.prepared.settings.device)

    @property
    def finished(self) -> bool:
        settings = self.prepared.settings
        return not settings.run.force and state(Path(settings.store) / self.name) == "finished"


def run(
    config: Mapping[str, Any] | Configuration | Prepared,
    overrides: Sequence[str] = (),
    display: Display | None = None,
    name: str | None = None,
) -> Outcome:
    """Trains and evaluates the configuration, continues its interrupted run, or skips its finished one.

    `device=auto` takes a GPU that no other job has, and waits for one if there are only others. A finished run
    needs none.

    config: the resolved tree, or what was made of it already.
    name: id of an existing run; None: the configuration's.

    Raises:
        ValueError: a mistake in the configuration or the scene, or more than `run.hours` by what circuits cost, and
            nothing has been written; or more by the first steps, and there is a checkpoint.
        Diverged: the loss turned NaN or infinite; the last good checkpoint stays.
    """
    prepared = config if isinstance(config, Prepared) else prepare(config)
    name = name or prepared.find_id(prepared.settings.store)
    [outcome] = side_by_side([Job(prepared, overrides, display or Display(), name)])
    if isinstance(outcome, Exception):
        raise outcome
    return outcome


def side_by_side(jobs: Sequence[Job]) -> list[Outcome | Exception]:
    """Trains the jobs, of different ids, on one device, a step of each in turn: how each ended, or what `run` raises.

    Each computes what it would compute alone. An interruption ends all of them.
    """
    wanted = {job.device for job in jobs if not job.finished} or {"cpu"}
    assert len(wanted) == 1, wanted
    trainings: list[_Training] = []
    stops: Sequence[int] = ()

    def last_words() -> str | None:
        """Ends the records, if the last whole step of each is in a checkpoint."""
        going = list(trainings)
        if not going or any(training.trainer.saved != training.trainer.step for training in going):
            return None
        return "\n".join(dict.fromkeys(training.interrupt() for training in going))

    first = jobs[0].display
    with devices.dealt(wanted.pop(), first.note, first.stopping) as device:
        beside = sum(not job.finished for job in jobs)
        started = [partial(_run, job, device, beside, trainings, lambda: bool(stops)) for job in jobs]
        turns = Turns(started, devices.device_of(device))
        with stop_requests(last_words) as stops, contextlib.closing(turns):
            while turns.round():
                pass
    return turns.results()


def _run(
    job: Job,
    device: str,
    beside: int,
    trainings: "list[_Training]",
    stopped: Callable[[], bool],
    aside: Mapping[str, str],
) -> Generator[bool, None, Outcome]:
    """Yields before the first step and after each one, see `Turns`.

    beside: how many train in turns. trainings: those that have begun and go on. aside: which compiled loops stepped
    aside, and why.
    """
    prepared = replace(job.prepared, configuration=job.prepared.configuration.with_values({"device": device}))
    display, settings, task = job.display, prepared.settings, prepared.task
    if settings.threads is not None:
        torch.set_num_threads(settings.threads)
    task.build(settings)

    known = None
    if not job.finished and settings.torch_device.type == "cpu":
        step = beside * seconds_of_circuits(task.model, task.points_a_step)
        known = step > LONG and foretold("circuits alone: ", step, step * settings.train.steps, settings.run.hours)
    configuration = prepared.configuration
    columns = labels(configuration.acting) | parameter_counts(task.model) | auto.columns(prepared.decisions)
    columns |= {**task.columns, "scene.fingerprint": task.fingerprint, "steps": 0}
    store = RunStore(settings.store)
    claim = store.claim(
        job.name,
        configuration.acting,
        job.overrides,
        columns=columns,
        types=configuration.types,
        force=settings.run.force,
    )
    if claim.outcome in ("finished", "resumed"):
        _compare(claim.dir, configuration, display)
    if claim.run is None:
        return Outcome(job.name, claim.dir, claim.outcome, read_summary(claim.dir), claim.message)
    with claim.run as record:
        if claim.outcome == "resumed":
            display.note(claim.message)
        _describe(prepared, record, display)
        if known:
            display.note(known)
        record.write_environment(capture(settings.seed), dirty_diff())
        if task.transform is not None:
            record.write_transform(task.transform.numpy())
        training = _Training(task, record, display, beside, stopped)
        trainings.append(training)
        try:
            yield False
            return (yield from training.finish(aside))
        except Exception as error:
            if beside > 1:  # the others go on
                display.note(f"failed: {error}")
            raise
        finally:
            trainings.remove(training)


def _describe(prepared: Prepared, record: Run, display: Display) -> None:
    """Says what is trained, on what, and what about the scene is doubtful."""
    task = prepared.task
    display.note("; ".join(filter(None, [f"scene {task.name}: {task.description()}", task.notes()])))
    display.describe(prepared.configuration.acting, parameter_counts(task.model))
    if prepared.decisions:
        decided = [f"{option}={decision.value}" for option, decision in prepared.decisions.items()]
        display.note(f"the scene needs {', '.join(decided)}")
    if not record.resumed and prepared.settings.scene.get("path"):
        for doubt in task.doubts():
            display.note(f"warning: {doubt}")


def _compare(run: Path, configuration: Configuration, display: Display) -> None:
    """Says in what a run of the store was recorded otherwise; StoreError if it computes something else."""
    differences = configuration.differences(Configuration.of(read_config(run)))
    if decisive := [name for name in differences if name not in RECORDED]:
        listed = ", ".join(f"{name}={differences[name][0]} (today {differences[name][1]})" for name in decisive)
        raise StoreError(f"{run}: was trained by a version with other defaults: {listed}; run.force=true does it over")
    if differences:
        listed = ", ".join(f"{name}={before} (asked for {now})" for name, (before, now) in differences.items())
        display.note(f"{run} was recorded with {listed}; run.force=true does it over")


class _Training:
    """A run from its last checkpoint, or from the start, to its results or to where it is stopped."""

    def __init__(self, task: Task, record: Run, display: Display, beside: int, stopped: Callable[[], bool]) -> None:
        self.task, self.settings, self.beside = task, task.settings, beside
        self.record, self.display, self.stopped = record, display, stopped
        watch = Stopwatch(self.settings.torch_device, task.model, QuantumLayer)
        self.trainer, self.evaluator = task.trainer(watch), task.evaluator(watch)
        self.preview = Preview(self.settings.run.preview_seconds, self.evaluator.preview, record.save_preview)
        chosen = even_subset(len(task.eval), task.curve_views or None)
        self.curve_views = [task.eval[index] for index in chosen]
        trained = self.trainer.rays_a_step * self.settings.train.eval_every
        self.curve_rays = math.ceil(max(FEWEST, SHARE / FORWARD * trained) / max(len(chosen), 1))
        self.pruned = False
        self.taken = 0  # steps, by this command

    def interrupt(self) -> str:
        """Ends the record after the last checkpoint; what to tell the user."""
        step = self.trainer.step
        self.record.interrupt(step)
        return _stopped(step, self.settings.train.steps, self.settings.run.force)

    def finish(self, aside: Mapping[str, str]) -> Generator[bool, None, Outcome]:
        """aside: see `_run`."""
        if self.record.resumed:
            checkpoint = self.record.go_on(self.trainer.check)
            if checkpoint is not None:
                self.trainer.load(checkpoint)
            self.record.write_summary({"stopped": None})
        steps = self.settings.train.steps
        self.display.begin(self.record.dir, self.trainer.step, steps)
        try:
            measured = yield from self.train()
        finally:
            self.display.end()
        if not self.trainer.done or measured is None:
            return _stop(self.record, self.trainer.step, steps, self.pruned, self.settings.run.force)
        path = self.record.dir
        self.record.finish(measured | self.timings() | logged_times(path) | {"loops": dispatch.described(aside)})
        return Outcome(self.record.run_id, path, "finished", read_summary(path), "")

    def train(self) -> Generator[bool, None, Measures | None]:
        """Trains, and evaluates on the way. Yields after each step, and returns the means of the last evaluation if
        there was one."""
        trainer, record = self.trainer, self.record
        measured = None
        if trainer.step and self.is_due() and not was_evaluated(record.dir, trainer.step):  # it was stopped in there
            measured = self.assess()
        # Rows are logged before the checkpoint of their step, so a resumed run neither repeats nor misses one.
        for metrics in trainer.steps(record, self.stopping):
            self.display.phase("train")
            if untaught := ", ".join(trainer.untaught):
                self.display.note(f"warning: no gradient reaches the parameters of {untaught}: they stay as they are")
            if metrics:
                record.log(trainer.step, trainer.seconds, metrics)
                self.display.step(trainer.step, metrics)
            self.foresee()
            if self.is_due() or trainer.step_seconds[-1] > SLOW:  # a stop may have to end what comes next at once
                trainer.save(record)
            self.show()
            if self.is_due():
                measured = self.assess()
            yield trainer.replayed and not self.is_due()
        self.show(now=True)
        if trainer.done and measured is None and not self.stopping():  # killed between the last checkpoint and the end
            _, measured = self.evaluate(self.task.eval)
        return measured

    def foresee(self) -> None:
        """Says what the training is going to take, after a step without compiling; ValueError as `foretold`."""
        trainer, train = self.trainer, self.settings.train
        step = self.beside * trainer.step_seconds[-1]
        self.taken += 1
        if self.taken != 2 + (step < LONG):
            return
        left = train.steps - trainer.step
        rays = self.task.rays_of(self.task.eval)
        evaluation = step * FORWARD * rays / trainer.rays_a_step
        whole = step * left * (1 + SHARE * bool(rays)) + evaluation
        if whole > 3600 * self.settings.run.hours:
            trainer.save(self.record)
        if line := foretold("", step, whole, self.settings.run.hours):
            self.display.note(line)
        if evaluation > WORTH_A_MENTION:
            views = f"{len(self.task.eval)} whole held-out views"
            self.display.note(f"after the last step, {views} take about {evaluation / 60:,.0f} minutes")

    def show(self, *, now: bool = False) -> None:
        """Refreshes the preview, unless it would take minutes."""
        if max(self.trainer.step_seconds[-1:], default=0) < LONG:
            self.preview.refresh(self.trainer.step, now=now)

    def assess(self) -> Measures | None:
        """Evaluates the views that are due after this step, and logs their means; None if the run is to stop."""
        task, trainer = self.task, self.trainer
        views = task.eval if trainer.done else self.curve_views
        rows, result = self.evaluate(views, None if trainer.done else self.curve_rays)
        if result is not None:
            # Every point of the curve is a mean over the same views; before the last step, over some of their pixels.
            curve = means([row for view, row in zip(views, rows, strict=True) if view in self.curve_views])
            logged = {f"eval/{key}": value for key, value in curve.items() if is_number(value)}
            self.record.log(trainer.step, trainer.seconds, logged)
            on = f"{len(self.curve_views)} of {len(task.eval)} {task.held_out}" if task.held_out else ""
            self.display.held_out(trainer.step, task.headline, curve[task.headline], on)
            self.pruned = not trainer.done and self.display.unpromising(self.record.dir, trainer.step, curve)
        return result

    def evaluate(self, views: Sequence[int], rays: int | None = None) -> tuple[list[Measures], Measures | None]:
        step = self.trainer.step
        found = evaluate(self.evaluator, self.record, views, step, self.stopping, self.display.phase, rays)
        share = (found[1] or {}).get("explained")
        if is_number(share) and share < COLORLESS and step >= EARLY:
            told = f"after {step} steps the model explains {max(share, 0):.0%} of the variance of the colours"
            self.record.warn(f"colourless: {told}; {self.task.brings_color} may mend it")
        return found

    def stopping(self) -> bool:
        return self.pruned or self.stopped() or self.display.stopping()

    def is_due(self) -> bool:
        """Whether an evaluation is due after this step."""
        every = self.settings.train.eval_every
        return self.trainer.done or bool(every and self.trainer.step % every == 0)

    def timings(self) -> Measures:
        """Columns of the summary about the training as a whole."""
        return {
            "train_s": self.trainer.seconds,
            "step_ms": median_ms(self.trainer.step_seconds),
            "steps": self.trainer.step,
            "stopped": PLATEAU if self.trainer.plateau.reached else None,
            "peak_memory_mb": peak_memory_mb(self.settings.torch_device) if self.beside == 1 else None,
            "time.beside": self.beside,
            "time.threads": torch.get_num_threads(),
            "machine": machine(self.settings.torch_device),
        }


def _stop(record: Run, step: int, steps: int, pruned: bool, force: bool) -> Outcome:
    """Ends a run that is not finished."""
    message = _stopped(step, steps, force)
    if pruned:
        record.write_summary({"stopped": PRUNED})
        message = f"pruned at step {step} of {steps}: finished runs were better by then"
    record.interrupt(step)
    return Outcome(record.run_id, record.dir, PRUNED if pruned else "interrupted", read_summary(record.dir), message)


def _stopped(step: int, steps: int, force: bool) -> str:
    command = "the same command without run.force=true" if force else "the same command"
    return f"stopped at step {step} of {steps}; {command} continues from there"


def was_evaluated(path: Path, step: int) -> bool:
    """Whether the run has logged an evaluation after this step."""
    logged = read_metrics(path)
    return bool(logged["key"][logged["step"] == step].str.startswith("eval/").any())


def evaluate(
    evaluator: ViewEvaluator,
    record: Run,
    views: Sequence[int],
    step: int,
    stopping: Callable[[], bool],
    tell: Callable[[str], None] = lambda phase: None,
    rays: int | None = None,
) -> tuple[list[Measures], Measures | None]:
    """Measures the views and writes eval.parquet and the pictures; returns the row of each view, and the means.

    stopping: called after each view but the last. Once it is true, there are no means, and no table is written.
    tell: called with the phase before each view, `evaluate 3 of 22 views`.
    rays: about how many of each view are measured; None: all.
    """
    start = time.perf_counter()
    rows = []
    scene = evaluator.scene
    names = dict(zip(scene.eval, picture_names([scene.names[view] for view in scene.eval]), strict=True))
    tell(f"evaluate 1 of {len(views)} views")
    for rendered, row in evaluator.views(list(views), step, rays):
        rows.append(row)
        if len(rows) < len(views):
            tell(f"evaluate {len(rows) + 1} of {len(views)} views")
        record.save_image(names[rendered.view], evaluator.picture(rendered))
        if len(rows) < len(views) and stopping():
            return rows, None
    record.write_eval(rows)
    measured = means(rows)
    measured |= {"eval_views": len(rows), "eval_s": time.perf_counter() - start}
    if measured.get("psnr", 0.0) is None:
        measured["psnr_reason"] = "the masks leave no pixel of the held-out views"
        record.warn(f"no psnr: {measured['psnr_reason']}")
    record.write_summary(measured | {"steps": step})
    return rows, measured


def means(rows: Sequence[Measures]) -> Measures:
    """Mean of each metric over the views that have it, else None, and the first `<metric>_reason` of each."""
    result: Measures = {}
    for key in [item.key for item in quality_metrics() if any(item.key in row for row in rows)]:
        values = [value for row in rows if is_number(value := row[key])]
        result[key] = sum(values) / len(values) if values else None
    reasons = dict.fromkeys(key for row in rows for key in row if key.endswith("_reason"))
    return result | {key: next((row[key] for row in rows if row[key]), None) for key in reasons}


def logged_times(path: Path) -> dict[str, float]:
    """Medians over the logged steps after the first 50: CPU milliseconds of a step, milliseconds of its parts, load.

    Over all logged steps if there are no more than that, as `median_ms`.
    """
    logged = read_metrics(path)
    logged = logged[logged["key"].str.startswith("time/")]
    late = logged[logged["step"] >= 50]
    times = (logged if late.empty else late).groupby("key")["value"].median()
    names = {"step_cpu_ms": "step_cpu_ms", "time.load": "load", **{f"time.{part}_ms": f"{part}_ms" for part in STAGES}}
    return {name: float(times.get(f"time/{key}", float("nan"))) for name, key in names.items()}
