"""One run, top to bottom: scene -> rays -> samples -> field -> render -> loss -> metrics -> parquet."""

import contextlib
import math
import os
import signal
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch

from qnerf import auto
from qnerf.auto import poses
from qnerf.config.identity import picture_names, run_id
from qnerf.config.plugins import import_plugins
from qnerf.config.registry import Registry, check_options, options_of
from qnerf.config.settings import (
    Settings,
    SignalSettings,
    check_settings,
    declared,
    only_acting,
    require,
    schema,
    settings_from,
    signal_settings_from,
)
from qnerf.encoders import DIRECTIONS, ENCODERS
from qnerf.geometry.contraction import CONTRACTIONS, Contraction
from qnerf.geometry.hull import visual_hull
from qnerf.geometry.pose_noise import add_pose_noise
from qnerf.geometry.pose_refinement import CAMERAS
from qnerf.geometry.rays import RayTable
from qnerf.geometry.visibility import SpaceMask, visible_cells
from qnerf.heads import HEADS, Head, head_options
from qnerf.heads.activations import COLOR_ACTIVATIONS, DENSITY_ACTIVATIONS
from qnerf.heads.qiren import Normalisation, check_samples
from qnerf.metrics import quality_metrics
from qnerf.model.field import Field
from qnerf.model.labels import LABELLED, labels, slug
from qnerf.model.memory import planned, require_memory, samples_per_ray
from qnerf.model.model import Model
from qnerf.model.occupancy import Occupancy
from qnerf.quantum import QuantumLayer
from qnerf.records import Run, RunStore, StoreError, read_config, read_metrics, read_summary
from qnerf.records.environment import capture, dirty_diff
from qnerf.records.filters import is_number
from qnerf.rendering.samplers import SAMPLERS, Sampler
from qnerf.rendering.shading import SHADINGS
from qnerf.scenes import SCENES, Scene
from qnerf.scenes.base import even_subset
from qnerf.signals import Signal, SignalEvaluator, SignalModel, SignalTrainer, build_signal_model, is_signal
from qnerf.timing import STAGES, Stopwatch, median_ms, peak_memory_mb
from qnerf.training import lpips
from qnerf.training.checked_trainer import FILE as NONFINITE
from qnerf.training.checked_trainer import CheckedTrainer, RunContext
from qnerf.training.evaluation import Evaluator, colormap
from qnerf.training.preview import Preview
from qnerf.training.state_checks import largest_state
from qnerf.training.trainer import Trainer


@dataclass(frozen=True)
class Outcome:
    """How a command ended: `state` is finished, interrupted, or busy (another process writes the run)."""

    run_id: str
    path: Path
    state: str
    summary: dict[str, Any]
    message: str


class ViewEvaluator(Protocol):
    """Measures and draws views of its scene."""

    scene: Any

    def views(self, views: list[int], step: int) -> Iterator[tuple[Any, "Measures"]]: ...

    def preview(self, step: int) -> np.ndarray: ...

    def picture(self, rendered: Any) -> np.ndarray: ...


Measures = dict[str, float | str | None]
"""Metric -> value; None if it cannot be computed."""


class Display:
    """Receives the progress of a run. This one is silent; the command line has one that prints."""

    def begin(self, path: Path, step: int, steps: int) -> None: ...

    def phase(self, name: str) -> None:
        """What goes on from now on: train, or evaluate; from `begin` to the first step it is compile."""

    def step(self, step: int, metrics: Mapping[str, float]) -> None: ...

    def held_out(self, step: int, metric: str, value: float | str | None, views: str) -> None:
        """The mean of a metric over held-out views; `views` says which, `4 of 22 views`, the same ones throughout.

        A signal, which has no views, has an empty text.
        """

    def note(self, text: str) -> None: ...

    def end(self) -> None: ...


def component(registry: Any, node: Mapping[str, Any], *wiring: Any) -> Any:
    """Builds the component `node["name"]` with the node's other keys as options."""
    options = {key: value for key, value in node.items() if key != "name"}
    return registry.build(node["name"], *wiring, **options)


def prepare_signal(config: Mapping[str, Any]) -> tuple[SignalSettings, Signal]:
    """The settings of a configuration that fits a signal with one head, and the signal; ValueError as `prepare`."""
    check_settings(config)
    import_plugins(config["plugins"])
    check_components(config)
    return signal_settings_from(config), component(SCENES, config["scene"])


def prepare(config: Mapping[str, Any], *, begun: bool = False) -> tuple[dict[str, Any], Settings, Scene]:
    """The configuration with every `auto` resolved for its scene, its settings, and the scene.

    begun: if the run exists in its store, reuse its stored `auto` decisions.

    Raises:
        ValueError: an option with a value that it cannot have, a scene that cannot be read, or a signal.
    """
    if schema(config) is not Settings:
        raise ValueError("expected a radiance field; the configuration has one head, which fits a signal")
    undecided = auto.asked(config)
    check_settings(config, undecided)
    import_plugins(config["plugins"])
    check_components(config, undecided)
    if not undecided:
        settings = settings_from(config)
        return dict(config), settings, build_scene(settings)
    scene = add_pose_noise(component(SCENES, config["scene"]), **config["pose_noise"])
    if begun and not config["run"]["force"]:
        config = {**config, "needs": {**needs_of(config, scene), **config["needs"]}}
    resolved = auto.resolve(config, scene)
    settings = settings_from(resolved)
    check_components(resolved)
    check_background(scene, settings)
    return resolved, settings, scene


COMPONENTS: dict[str, Registry[Any]] = {
    "contraction": CONTRACTIONS,
    "encoder": ENCODERS,
    "scene": SCENES,
    "sampler": SAMPLERS,
    "shading": SHADINGS,
    "cameras": CAMERAS,
}
"""Group -> the registry of the component that its key `name` chooses."""
SHARED: dict[str, tuple[Registry[Any], str]] = {
    "hash": (ENCODERS, "hash"),
    "proposal": (SAMPLERS, "proposal"),
    "qiren": (HEADS, "qiren"),
    "qfgn": (HEADS, "qfgn"),
}
"""Group of defaults -> the component whose options they are."""


def check_components(config: Mapping[str, Any], undecided: Collection[str] = ()) -> None:
    """ValueError unless the options of all components fit their declarations, those of unused heads and tables too.

    undecided: as in `check_settings`, which has checked the config before. While there are any, every option may be
    `auto`: it may be the copy of an undecided one.
    """
    tables = [option for option in undecided if option.startswith("hash.")]
    undecided = {*undecided, *(option.replace("hash.", "encoder.") for option in tables)}  # the encoder follows them

    def check(group: str, node: Any, *components: Callable[..., Any]) -> None:
        """Each option of the node, which is one of any of the components."""
        require(group, node, ())
        for key, value in node.items():
            if key != "name" and not (undecided and value == auto.AUTO):
                owner = next((one for one in components if key in options_of(one)), components[0])
                check_options(f"{group}.", owner, {key: value})

    if is_signal(config["scene"]) != ("head" in config):
        heads = "density and color" if "head" in config else "head"
        name = config["scene"]["name"]
        raise ValueError(f"scene={name} needs the group {heads}; choose it with scene={name}, not by scene.name")
    for group, registry in COMPONENTS.items():
        if group not in config:
            continue
        names = registry.names() if f"{group}.name" in undecided else [config[group]["name"]]
        check(group, config[group], *map(registry.get, names))
    for group, (registry, name) in SHARED.items():
        if group not in config:
            continue
        require(group, config[group], LABELLED.get(group, ()))
        check(group, config[group], registry.get(name))
    for group in filter(config.__contains__, ("density", "color", "head")):
        node = config[group]
        HEADS.get(node["name"])
        for key in [key for key in node if key not in declared(group)]:
            if key not in HEADS.names():
                known = ", ".join([*declared(group), *HEADS.names()])
                raise ValueError(f"{group}: unknown option {key}={node[key]!r}; known: {known}")
            check(f"{group}.{key}", node[key], HEADS.get(key))


def needs_of(config: Mapping[str, Any], scene: Scene) -> dict[str, Any]:
    """The stored `auto` decisions of this configuration's run; empty if there is no run yet."""
    try:
        stored = read_config(Path(config["store"]) / id_of(config, scene))
    except StoreError:
        return {}
    return dict(stored.get("needs") or {})


def id_of(config: Mapping[str, Any], scene: Scene | Signal) -> str:
    """The id of the configuration's run; if the store has only a run under the scene's older fingerprint, its id."""
    ids = [run_id(slug(config), config, fingerprint) for fingerprint in scene.fingerprints]
    return next((name for name in ids if os.path.isdir(os.path.join(config["store"], name))), ids[0])


def build_scene(settings: Settings) -> Scene:
    scene = add_pose_noise(component(SCENES, settings.scene), **vars(settings.pose_noise))
    check_background(scene, settings)
    return scene


def check_background(scene: Scene, settings: Settings) -> None:
    if scene.has_alpha and settings.render.background == "last_sample":
        raise ValueError(
            f"scene {scene.name}: the images have alpha, which render.background=last_sample cannot be compared with; "
            "use render.background=white, black or random"
        )


def build_head(node: Mapping[str, Any], in_dim: int, out_dim: int) -> Head:
    """The head that `node`, the group density or color, chooses."""
    return HEADS.build(node["name"], in_dim, out_dim, **head_options(node))


def build_field(settings: Settings, views: int, trained: Sequence[int]) -> Field:
    """Builds contraction, encoder, density head and colour head, in the order in which a point passes them.

    views: number of views of the scene. trained: indices of the training views.
    """
    contraction = component(CONTRACTIONS, settings.contraction)
    encoder = component(ENCODERS, settings.encoder, 3)
    density = build_head(settings.density, encoder.out_dim, 1 + settings.geo_features)
    kind = settings.color["directions"]
    options = {"sh": {"degree": settings.color["degree"]}, "raw": {"scale": settings.color["direction_scale"]}}
    interval = settings.color["direction_interval"]
    directions = DIRECTIONS.build(kind, interval=interval, **options.get(kind, {}))
    color_in = directions.out_dim + settings.geo_features + settings.appearance
    color = build_head(settings.color, color_in, 3)
    activations = (
        DENSITY_ACTIVATIONS.get(settings.density["activation"]),
        COLOR_ACTIVATIONS.get(settings.color["activation"]),
    )
    initial = settings.density["initial"]
    appearance = settings.appearance
    return Field(contraction, encoder, directions, density, color, *activations, initial, views, trained, appearance)


def build_field_and_sampler(settings: Settings, scene: Scene) -> tuple[Field, Sampler]:
    field = build_field(settings, len(scene.cameras), scene.train)
    return field, component(SAMPLERS, settings.sampler, field.contraction)


def build_model(settings: Settings, scene: Scene) -> Model:
    """Field, sampler and pose refinement for the scene, in the run's dtype, on its device."""
    previous = torch.get_default_dtype()
    torch.set_default_dtype(settings.dtype)
    try:
        if parts := planned(lambda: build_field_and_sampler(settings, scene)):
            require_memory(settings, *parts, scene.cameras.width * scene.cameras.height)
        torch.manual_seed(settings.seed)
        field, sampler = build_field_and_sampler(settings, scene)
        cameras = component(CAMERAS, settings.cameras, scene.cameras.poses.shape[0], scene.train)
        field.mask = sampler.mask = build_mask(settings, scene, field.contraction)
        return Model(field, sampler, cameras, component(SHADINGS, settings.shading)).to(settings.torch_device)
    finally:
        torch.set_default_dtype(previous)


def check_samples_of_a_step(settings: Settings, model: Model) -> None:
    """ValueError if a circuit head could get too few samples in a training step."""
    # With a mask, only the last sample of each ray is sure to be evaluated. Shadings make sure of enough colours.
    rendered = 1 if model.field.mask is not None else samples_per_ray(model.sampler)[0]
    heads = [model.field.density_head, *([model.field.color_head] if settings.shading["name"] == "none" else [])]
    if any(isinstance(module, Normalisation) for head in heads for module in head.modules()):
        check_samples(settings.train.rays * rendered)


def build_mask(settings: Settings, scene: Scene, contraction: Contraction) -> SpaceMask | None:
    """Where density may be: seen by enough cameras, inside the silhouettes, and not empty; None: everywhere."""
    cameras, n = settings.visibility.cameras, settings.visibility.resolution
    grids = []
    if cameras:
        grids.append(visible_cells(contraction, scene.cameras, scene.train, cameras, n))
    if settings.visibility.alpha:
        grids.append(visual_hull(contraction, scene, n))
    if not grids and not settings.occupancy.every:
        return None
    allowed = torch.stack(grids).all(0) if grids else torch.ones(n, n, n, dtype=torch.bool)
    if not bool(allowed.any()):
        raise ValueError("visibility: no cell is both inside the silhouettes and seen by enough cameras; turn one off")
    if not settings.occupancy.every:
        return SpaceMask(allowed)
    options = {name: getattr(settings.occupancy, name) for name in ("every", "after", "min_opacity")}
    return Occupancy(allowed, contraction, **options)


def ray_table(settings: Settings, scene: Scene) -> RayTable:
    near, far = settings.render.near, settings.render.far
    stride = round(1 / settings.stop.share) if settings.stop.every else 0
    widths = math.prod(set(scene.cameras.all_sizes[:, 0].tolist()))
    while stride and math.gcd(stride, widths) > 1:  # otherwise it would hold out the same few columns of every image
        stride += 1
    return RayTable(
        scene, near=near, far=far, device=settings.torch_device, dtype=settings.dtype, validation_stride=stride
    )


def parameter_counts(model: Model | SignalModel) -> dict[str, int]:
    counts = {f"params.{name}": sum(p.numel() for p in parameters) for name, parameters in model.parts.items()}
    if isinstance(model, Model):
        counts.setdefault("params.appearance", 0)
    return counts | {"params.total": sum(counts.values())}


@contextlib.contextmanager
def stop_requests() -> Iterator[list[int]]:
    """Collects SIGINT, SIGTERM and SIGHUP, so that the run can stop with a checkpoint.

    A second SIGINT or SIGTERM acts as usual. SIGHUP may come many times, because a terminal that closes sends it more
    than once; it stays ignored if it is (`nohup`).

    SIGUSR1 and SIGUSR2 are collected, too, if they have a handler: a scheduler's launcher puts the job back into the
    queue with it. That handler is called at the end, when the run has stopped.
    """
    received: list[int] = []
    previous: dict[signal.Signals, Any] = {}
    urgent = (signal.SIGINT, signal.SIGTERM)

    def note(number: int, _frame: object) -> None:
        received.append(number)
        for kind in urgent if number in urgent else [signal.Signals(number)] if number in warnings else []:
            signal.signal(kind, previous[kind])

    hangups = [kind for kind in signal.Signals if kind.name == "SIGHUP"]  # there is none on Windows
    hangups = [kind for kind in hangups if signal.getsignal(kind) is not signal.SIG_IGN]
    warnings = [kind for kind in signal.Signals if kind.name in ("SIGUSR1", "SIGUSR2")]
    warnings = [kind for kind in warnings if callable(signal.getsignal(kind))]
    for kind in (*urgent, *hangups, *warnings):
        with contextlib.suppress(ValueError):  # outside the main thread signals cannot be handled
            previous[kind] = signal.signal(kind, note)
    try:
        yield received
    finally:
        for kind, handler in previous.items():
            signal.signal(kind, handler)
        for kind in warnings:
            if kind in received:
                signal.raise_signal(kind)


class FieldTask:
    """Trains a radiance field on posed images. ValueError as `run`."""

    def __init__(self, config: Mapping[str, Any]) -> None:
        self.config, self.settings, self.scene = prepare(config, begun=True)
        if self.settings.threads is not None:
            torch.set_num_threads(self.settings.threads)
        self.model = build_model(self.settings, self.scene)
        check_samples_of_a_step(self.settings, self.model)
        self.table = ray_table(self.settings, self.scene)
        self.curve_views = self.settings.train.eval_views
        # Files that cannot be used are reported now, not at the first evaluation.
        lpips.weights()
        colormap()

    def trainer(self, watch: Stopwatch, store: Run) -> Trainer:
        if not self.settings.numerics.finite_checks:
            return Trainer(self.model, self.table, self.settings, watch)
        context = RunContext(self.scene.names, store.config, store.dir / NONFINITE)
        return CheckedTrainer(self.model, self.table, self.settings, watch, context)

    def evaluator(self, watch: Stopwatch) -> Evaluator:
        background, chunk = self.settings.render.background, self.settings.train.chunk
        return Evaluator(self.scene, self.table, self.model, background=background, chunk=chunk, watch=watch)


class SignalTask:
    """Trains one head on a signal. ValueError as `run`."""

    curve_views = 0

    def __init__(self, config: Mapping[str, Any]) -> None:
        self.config = config
        self.settings, self.scene = prepare_signal(config)
        if self.settings.threads is not None:
            torch.set_num_threads(self.settings.threads)
        self.model = build_signal_model(self.settings, self.scene)
        colormap()

    def trainer(self, watch: Stopwatch, store: Run) -> SignalTrainer:
        return SignalTrainer(self.model, self.scene, self.settings, watch)

    def evaluator(self, watch: Stopwatch) -> SignalEvaluator:
        return SignalEvaluator(self.model, self.scene, self.settings, watch)


Task = FieldTask | SignalTask
"""What a run trains on, what it trains, how a step's loss is computed, and how the result is judged."""


def scene_of(config: Mapping[str, Any]) -> Scene | Signal:
    """The scene of a configuration; ValueError as `prepare`."""
    return prepare_signal(config)[1] if schema(config) is SignalSettings else prepare(config)[2]


def run(
    config: Mapping[str, Any],
    overrides: Sequence[str] = (),
    display: Display | None = None,
    stopping: Callable[[], bool] = lambda: False,
    name: str | None = None,
) -> Outcome:
    """Trains and evaluates the configuration, continues its interrupted run, or skips its finished one.

    stopping: called before every step. Once it is true, or on SIGINT, SIGTERM or SIGHUP, the run stops with a
        checkpoint.
    name: id of an existing run; older runs keep their original id.

    Raises:
        ValueError: a mistake in the configuration or the scene; nothing has been written.
        Diverged: the loss turned NaN or infinite; the last good checkpoint stays.
    """
    display = display or Display()
    config = only_acting(config, overrides)
    task: Task = SignalTask(config) if schema(config) is SignalSettings else FieldTask(config)
    settings, scene = task.settings, task.scene

    name = name or id_of(config, scene)
    decisions = task.config["needs"]
    config = config | {"needs": decisions}
    # The older fingerprint connects this run with older runs of the scene.
    fingerprints = {"scene.fingerprint": scene.fingerprint, "scene.older_fingerprint": scene.older_fingerprint}
    columns = labels(task.config) | parameter_counts(task.model) | fingerprints | {"steps": 0}
    claim = RunStore(settings.store).claim(name, config, overrides, columns=columns, force=settings.run.force)
    if claim.run is None:
        summary = read_summary(claim.dir)
        if claim.outcome == "finished" and (state := summary.get("state")) != "finished":
            raise StoreError(
                f"{claim.dir}: status.json says finished, summary.parquet says {state}; run.force=true does it over"
            )
        return Outcome(name, claim.dir, claim.outcome, summary, claim.message)
    with claim.run as store, stop_requests() as stops:
        if claim.outcome == "resumed":
            display.note(claim.message)
        decided = [f"{key}={node['value']}" for key, node in decisions.items() if isinstance(node, Mapping)]
        if decided:
            display.note(f"the scene needs {', '.join(decided)}")
        store.write_environment(capture(settings.seed), dirty_diff())
        if isinstance(scene, Scene):
            store.write_transform(scene.transform.numpy())
            if not store.resumed and config["scene"].get("path") and (doubt := poses.warning(scene)):
                display.note(f"warning: {doubt}")
        return _execute(task, store, display, lambda: bool(stops) or stopping())


def _execute(task: Task, store: Run, display: Display, stopping: Callable[[], bool]) -> Outcome:
    settings, scene = task.settings, task.scene
    watch = Stopwatch(settings.torch_device, task.model, QuantumLayer)
    trainer, evaluator = task.trainer(watch, store), task.evaluator(watch)
    max_bytes = largest_state(task.model, settings.train.steps)
    checkpoint = store.load_checkpoint(trainer.check, max_bytes) if store.resumed else None
    if checkpoint is not None:
        trainer.load(checkpoint)
    if store.resumed:
        store.resume(trainer.step)

    train = settings.train
    measured = None
    preview = Preview(settings.run.preview_seconds, evaluator.preview, store.save_preview)
    curve_views = [scene.eval[index] for index in even_subset(len(scene.eval), task.curve_views or None)]

    def assess() -> Measures | None:
        """Evaluates the views that are due after this step, and logs their means; None if the run is to stop."""
        views = scene.eval if trainer.done else curve_views
        rows, result = evaluate(evaluator, store, views, trainer.step, stopping, display.phase)
        if result is not None:
            # Every point of the curve is a mean over the same views.
            curve = means([row for view, row in zip(views, rows, strict=True) if view in curve_views])
            store.log(trainer.step, trainer.seconds, {f"eval/{k}": v for k, v in curve.items() if is_number(v)})
            measured_on = f"{len(curve_views)} of {len(scene.eval)} views" if isinstance(scene, Scene) else ""
            display.held_out(trainer.step, scene.headline, curve[scene.headline], measured_on)
        return result

    def is_due() -> bool:
        return trainer.done or bool(train.eval_every and trainer.step % train.eval_every == 0)

    display.begin(store.dir, trainer.step, train.steps)
    try:
        if trainer.step and is_due() and not was_evaluated(store.dir, trainer.step):  # it was stopped in there
            measured = assess()
        # Rows are logged before the checkpoint of their step, so a resumed run neither repeats nor misses one.
        for metrics in trainer.steps(store, stopping):
            display.phase("train")
            if metrics:
                store.log(trainer.step, trainer.seconds, metrics)
                display.step(trainer.step, metrics)
            preview.refresh(trainer.step)
            if is_due():
                measured = assess()
        preview.refresh(trainer.step, now=True)
        if trainer.done and measured is None and not stopping():  # killed between the last checkpoint and the end
            _, measured = evaluate(evaluator, store, scene.eval, trainer.step, stopping, display.phase)
    finally:
        display.end()
    if not trainer.done or measured is None:
        store.interrupt()
        message = f"stopped at step {trainer.step} of {train.steps}; the same command continues from there"
        return Outcome(store.run_id, store.dir, "interrupted", read_summary(store.dir), message)

    timings = {
        "train_s": trainer.seconds,
        "step_ms": median_ms(trainer.step_seconds),
        "steps": trainer.step,
        "stopped": "plateau" if trainer.plateau.reached else None,
        "peak_memory_mb": peak_memory_mb(settings.torch_device),
    }
    store.finish(measured | timings | part_times(store.dir))
    return Outcome(store.run_id, store.dir, "finished", read_summary(store.dir), "")


def was_evaluated(path: Path, step: int) -> bool:
    """Whether the run has logged an evaluation after this step."""
    logged = read_metrics(path)
    return bool(logged["key"][logged["step"] == step].str.startswith("eval/").any())


def evaluate(
    evaluator: ViewEvaluator,
    store: Run,
    views: Sequence[int],
    step: int,
    stopping: Callable[[], bool],
    tell: Callable[[str], None] = lambda phase: None,
) -> tuple[list[Measures], Measures | None]:
    """Measures the views and writes eval.parquet and the pictures; returns the row of each view, and the means.

    stopping: called after each view but the last. Once it is true, there are no means, and no table is written.
    tell: called with the phase before each view, `evaluate 3 of 22 views`.
    """
    start = time.perf_counter()
    rows = []
    scene = evaluator.scene
    names = dict(zip(scene.eval, picture_names([scene.names[view] for view in scene.eval]), strict=True))
    tell(f"evaluate 1 of {len(views)} views")
    for rendered, row in evaluator.views(list(views), step):
        rows.append(row)
        tell(f"evaluate {min(len(rows) + 1, len(views))} of {len(views)} views")
        store.save_image(names[rendered.view], evaluator.picture(rendered))
        if len(rows) < len(views) and stopping():
            return rows, None
    store.write_eval(rows)
    measured = means(rows)
    measured |= {"eval_views": len(rows), "eval_s": time.perf_counter() - start}
    store.write_summary(measured | {"steps": step})
    return rows, measured


def means(rows: Sequence[Measures]) -> Measures:
    """Mean of each metric over the views that have it, else None, and the first `<metric>_reason` of each."""
    result: Measures = {}
    for key in [item.key for item in quality_metrics() if any(item.key in row for row in rows)]:
        values = [value for row in rows if is_number(value := row[key])]
        result[key] = sum(values) / len(values) if values else None
    reasons = dict.fromkeys(key for row in rows for key in row if key.endswith("_reason"))
    return result | {key: next((row[key] for row in rows if row[key]), None) for key in reasons}


def part_times(path: Path) -> dict[str, float]:
    """Median milliseconds of each part of a step, over the logged steps after the first 50."""
    logged = read_metrics(path)
    times = logged[logged["key"].str.startswith("time/") & (logged["step"] >= 50)].groupby("key")["value"].median()
    return {f"time.{part}_ms": float(times.get(f"time/{part}_ms", float("nan"))) for part in STAGES}
