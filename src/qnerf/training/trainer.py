"""The training loop: batches of rays, the loss, the optimiser, checkpoints."""

import contextlib
import copy
import math
import time
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping
from typing import Any, Protocol

import torch
from torch import Tensor, nn

from qnerf.config.settings import Schedule, Settings, SignalSettings, Train
from qnerf.config.tensors import require_tensor
from qnerf.geometry.rays import RayTable, sent
from qnerf.geometry.sparse_depths import SparseDepths
from qnerf.kernels.dispatch import is_plain
from qnerf.kernels.jit import one_torch_thread
from qnerf.model.model import Model
from qnerf.rendering.background import evaluation_background
from qnerf.rendering.samplers import SampledRays
from qnerf.scenes.base import composite
from qnerf.timing import STAGES, Stopwatch, load
from qnerf.training.captured import Graphs, Unread
from qnerf.training.error_map import ErrorMap
from qnerf.training.optimiser import apply_gradients, build_optimiser, forget_gradients
from qnerf.training.schedules import falls_from, learning_rate, paced
from qnerf.training.state_checks import check_shapes, first_non_finite
from qnerf.training.stopping import Plateau
from qnerf.training.terms import LOSSES, Step, weights_of
from qnerf.training.threads import few_products
from qnerf.types import Rendering

ADVICE = "the last checkpoint stays; a smaller train.lr or numerics.dtype=float64 is another run, from the start"

LOOKS = 20  # steps in which a part of the model may wait for its first gradient: an empty density gives none at first

SHARE_OF_POINTS = 8  # one ray in so many goes through a sparse point, if the loss takes those


class Diverged(RuntimeError):
    """The loss or a parameter is no longer finite."""


class Checkpoints(Protocol):
    """A store for the trainer's state."""

    def save_checkpoint(self, state: dict[str, Any]) -> None: ...


def decibels(mean_squared_error: float) -> float:
    """PSNR in dB of colours in [0, 1], at most 120.

    >>> decibels(0.01)
    20.0
    """
    return -10 * math.log10(max(mean_squared_error, 1e-12))


class Loop:
    """Takes training steps. `state()` holds everything that they depend on, so a resumed run repeats an uninterrupted
    one. What a step computes is up to `terms`.

    Args:
        model: on its device, in its dtype.
        settings: training budget and schedule.
        watch: times the stages of a step.
        plateau: when to stop early.
    """

    train: Schedule
    points_a_step: int
    """Points at which a step evaluates the model, known before `__init__`; so are the rays, or points, of a batch."""
    rays_a_step: int

    def __init__(self, model: Any, settings: Settings | SignalSettings, watch: Stopwatch, plateau: Plateau) -> None:
        self.model = model
        self.train = settings.train
        self.watch = watch
        self.step_seconds: list[float] = []
        self.idle = [name for name, parameters in model.parts.items() if parameters]  # no gradient but 0 so far
        self.seconds = 0.0  # of training so far, over all resumptions
        self.saved = 0  # the step of the last checkpoint; a run without one has lost nothing before its first step
        self.plateau = plateau
        device = settings.torch_device
        groups = [{"params": parameters, "name": name} for name, parameters in model.parts.items() if parameters]
        self.optimiser = build_optimiser(groups, self.train)
        self.paced = paced(model)
        self.graphs = Graphs(device, settings.run.capture)
        self.computing = ""  # what of a step was begun last, in words
        self.logged = False  # whether the metrics of this step are
        self.replayed = False  # whether a graph computed it
        self.few_products = device.type == "cpu" and few_products(model, self.points_a_step)
        self._set_step(0)
        # Separate streams: configurations with different samplers still see the same batches of rays.
        self.streams = {
            "pixels": torch.Generator().manual_seed(settings.seed),
            "samples": torch.Generator(device).manual_seed(settings.seed + 1),
        }

    def _set_step(self, step: int) -> None:
        """Everything that is a function of the step, so that a resumed run has it too."""
        self.step = self._number = step
        for part in self.paced:
            part.progress = step / self.train.steps
        self.rate = learning_rate(step, self.train)
        for group in self.optimiser.param_groups:
            group["lr"] = self.rate * getattr(self.train.rates, group["name"])

    def draw(self) -> list[Tensor]:
        """What of a batch is drawn on the CPU, from `streams["pixels"]`; on the device."""
        return []

    def terms(self, drawn: list[Tensor]) -> dict[str, Tensor]:
        """The weighted terms whose sum is minimised, of what `draw` returned. All that is random is drawn on the
        device, from `streams["samples"]`."""
        raise NotImplementedError

    @staticmethod
    def loss(terms: Mapping[str, Tensor]) -> Tensor:
        for name, term in terms.items():
            require_tensor(f"the loss term {name!r}", term, ())
        return torch.stack(list(terms.values())).sum()

    def phase(self) -> Hashable | None:
        """What decides how this step is computed: steps with equal ones are alike. None: nothing is settled yet."""
        return () if len(self.step_seconds) >= LOOKS else None

    @contextlib.contextmanager
    def unread(self) -> Iterator[Unread]:
        """Inside, nothing but what `phase` covers can read the number of the step, or the progress; all terms are
        computed, as in a step that is logged, and no stage is timed."""
        number: Any = Unread()
        timed, self.watch.active = self.watch.active, False
        logged, self.step, self.logged = self.logged, number, True
        for part in self.paced:
            part.progress = number
        try:
            yield number
        finally:
            self.watch.active, self.logged = timed, logged
            self._set_step(self._number)

    def take_step(self, measure: bool) -> dict[str, float]:
        """One optimisation step.

        Args:
            measure: return the step's metrics, with the time of each stage; else the result is empty. Only a measured
                step waits for a device other than the CPU; then it also waits for the steps before it.

        Raises:
            Diverged: the loss is not finite; the message names the step and the term or parameters at fault. On a
                device other than the CPU only a measured step looks.
        """
        start, cpu = self.watch.now(wait=measure), time.process_time()
        self.watch.begin(measure=measure)
        self.logged = measure
        rate = self.rate
        with self.graphs.stream():
            with one_torch_thread(self.few_products and not is_plain()):
                with self.watch.stage("sampling"):
                    drawn = self.draw()
                recorded = self.graphs.compute(self, drawn)
                self.replayed = recorded is not None
                loss, terms = recorded or self._gradients(drawn)
                # Another device computes on while its next steps are sent. To read a number is to wait for it.
                value = float(loss.detach()) if measure or loss.is_cpu else 0.0
            if not math.isfinite(value):
                raise Diverged(f"the loss is {value} at step {self.step}, {self._culprit(terms)}; {ADVICE}")
            with self.watch.stage("optimiser"):
                apply_gradients(self.optimiser)
        self._set_step(self.step + 1)
        seconds = self.watch.now(wait=measure) - start
        self.step_seconds.append(seconds)
        self.seconds += seconds
        if not measure:
            return {}
        return {
            "train/loss": value,
            **({"train/psnr": decibels(float(terms["mse"].detach()))} if "mse" in terms else {}),
            **{f"train/{name}": float(term.detach()) for name, term in terms.items()},
            "train/lr": rate,
            "time/step_ms": seconds * 1e3,
            "time/step_cpu_ms": (time.process_time() - cpu) * 1e3,
            "time/load": load(),
            # The stages of a recorded step are one.
            **({} if self.replayed else {f"time/{name}_ms": self.watch.seconds[name] * 1e3 for name in STAGES}),
        }

    def _gradients(self, drawn: list[Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
        """Computes the gradients, one operation after another; returns the loss and its terms."""
        terms = self.terms(drawn)
        with self.watch.stage("render"):
            loss = self.loss(terms)
        with self.watch.stage("backward"):
            forget_gradients(self.optimiser)
            loss.backward()
        if self.idle and len(self.step_seconds) < LOOKS:
            self.idle = [name for name in self.idle if not _learns(self.model.parts[name])]
        return loss, terms

    def _culprit(self, terms: dict[str, Tensor]) -> str:
        """The first parameters or loss term with a value that is not finite, in words."""
        for name, parameters in self.model.parts.items():
            if first_non_finite(name, parameters):
                return f"in the parameters of {name!r}"
        bad = [name for name, term in terms.items() if not math.isfinite(float(term.detach()))]
        return f"in the loss term {bad[0]!r}" if bad else "in the sum of the loss terms"

    def state(self) -> dict[str, Any]:
        """Everything the next step depends on."""
        return {
            "step": self.step,
            "model": self.model.state_dict(),
            "optimiser": self.optimiser.state_dict()["state"],
            "streams": {name: stream.get_state() for name, stream in self.streams.items()},
            "torch_random": torch.get_rng_state(),
            "plateau": self.plateau.state(),
            "step_seconds": torch.tensor(self.step_seconds, dtype=torch.float64),
        }

    def check(self, state: Mapping[str, Any]) -> None:
        """ValueError unless names, shapes and the step of `state` are those of this run. Nothing of it is loaded."""
        own = self.state()
        if different := ", ".join(sorted(map(str, own.keys() ^ state.keys())))[:100]:
            raise ValueError(f"differs in {different}: another version of qnerf wrote it")
        if state["step"] not in range(self.train.steps + 1):
            raise ValueError(f"step: expected 0 to {self.train.steps}, got {state['step']}")
        check_shapes("model", state["model"], own["model"])
        parameters = [parameter for group in self.optimiser.param_groups for parameter in group["params"]]
        for number, kept in state["optimiser"].items():
            moments = {key: value for key, value in kept.items() if value.dim()}
            check_shapes(f"optimiser.{number}", moments, dict.fromkeys(moments, parameters[number]))

    def load(self, state: Mapping[str, Any]) -> None:
        """Restores what `state()` returned.

        Raises:
            ValueError: it does not pass `check`; nothing has been restored.
        """
        try:
            self.check(state)
        except ValueError as error:
            raise ValueError(f"the checkpoint does not fit this run's model: {error}") from error
        self._set_step(state["step"])
        self.saved = self.step
        self.model.load_state_dict(state["model"])
        # The options of the groups are this run's.
        moments = copy.deepcopy(state["optimiser"])
        self.optimiser.load_state_dict(self.optimiser.state_dict() | {"state": moments})
        for name, stream in self.streams.items():
            saved = state["streams"][name]
            if len(saved) == len(stream.get_state()):
                stream.set_state(saved)
            else:  # from another kind of device, which draws other random numbers anyway
                stream.manual_seed(stream.initial_seed() + self.step)
        torch.set_rng_state(state["torch_random"])
        self.plateau.load(state["plateau"])
        self.step_seconds = state["step_seconds"].tolist()
        self.seconds = sum(self.step_seconds)

    @property
    def untaught(self) -> list[str]:
        """Right after the first `LOOKS` steps: the parts whose parameters got no gradient in any of them."""
        return self.idle if len(self.step_seconds) == LOOKS else []

    def validate(self) -> float:
        """PSNR in dB of data that is held out for validation; called if the plateau asks for it."""
        raise NotImplementedError

    @property
    def done(self) -> bool:
        """Whether the last step was taken, or the PSNR of the validation rays has reached a plateau."""
        return self.step >= self.train.steps or self.plateau.reached

    def steps(self, checkpoints: Checkpoints, stopping: Callable[[], bool]) -> Iterator[dict[str, float]]:
        """Trains until `done` or `stopping()`, and yields each step's metrics.

        Saves a checkpoint every `checkpoint_every` seconds and at the end. A state that is not finite is never saved,
        so the last good checkpoint stays.
        """
        saved = time.monotonic()
        while not self.done and not stopping():
            check = self.plateau.due(self.step + 1)
            measure = check or (self.step + 1) % self.train.log_every == 0 or self.step + 1 == self.train.steps
            metrics = self.take_step(measure)
            if check:
                metrics["validation/psnr"] = self.validate()
                self.plateau.add(metrics["validation/psnr"])
            yield metrics
            if time.monotonic() - saved > self.train.checkpoint_every:
                self.save(checkpoints)
                saved = time.monotonic()
        self.save(checkpoints)

    def save(self, checkpoints: Checkpoints) -> None:
        """Writes a checkpoint. Diverged if a parameter, a buffer or a value of the optimiser is not finite."""
        if self.step and self.saved == self.step:
            return
        state = self.state()
        for kind in ("model", "optimiser"):
            if name := first_non_finite(kind, state[kind]):
                raise Diverged(f"{name} is not finite after step {self.step - 1}; {ADVICE}")
        checkpoints.save_checkpoint(state)
        self.saved = self.step


def _learns(parameters: Iterable[nn.Parameter]) -> bool:
    """Whether any of the parameters has a gradient other than 0."""
    return any(one.grad is not None and bool((one.grad != 0).any()) for one in parameters)


class Trainer(Loop):
    """Trains a radiance field on batches of rays.

    Args:
        model: on its device, in its dtype.
        table: the training pixels and their rays.
        settings: training budget and schedule, early stopping, background.
        watch: times the stages of a step.
    """

    model: Model
    train: Train

    def __init__(self, model: Model, table: RayTable, settings: Settings, watch: Stopwatch) -> None:
        stop = settings.stop
        self.rays_a_step = settings.train.rays
        self.points_a_step = self.rays_a_step * model.sampler.rendered_samples
        # Most is gained while the rate falls: a plateau before that is not the end.
        plateau = Plateau(stop.every, stop.patience, stop.min_gain_db, after=falls_from(settings.train))
        super().__init__(model, settings, watch, plateau)
        self.table = table
        self.background = settings.render.background
        self.validation_rays = stop.rays
        self.weights = weights_of(settings.train)
        takes_points = "sparse_depth" in self.weights
        self.depths = SparseDepths(table.scene, table.validation_stride) if takes_points else None
        seen = (len(table.training), table.validation_stride, table.device, table.dtype)
        self.error_map = ErrorMap(*seen) if self.train.error_rays else None

    def state(self) -> dict[str, Any]:
        return super().state() | ({"errors": self.error_map.cells} if self.error_map else {})

    def load(self, state: Mapping[str, Any]) -> None:
        super().load(state)
        if self.error_map:
            self.error_map.cells.copy_(state["errors"])

    def phase(self) -> Hashable | None:
        settled = super().phase()
        return settled if settled is None else (settled, self.model.sampler.phase(self.step))

    def draw(self) -> list[Tensor]:
        """Numbers (R,) of training pixels; and with sparse points the distances (P,) of the first P."""
        numbers = self.table.draw(self.train.rays, self.streams["pixels"])
        if not self.depths:
            return [numbers]
        drawn, distances = self.depths.draw(self.train.rays // SHARE_OF_POINTS, self.streams["pixels"])
        numbers[: len(drawn)] = sent(drawn, numbers.device)
        return [numbers, sent(distances.to(self.table.dtype), numbers.device)]

    def terms(self, drawn: list[Tensor]) -> dict[str, Tensor]:
        numbers, distances = drawn[0], drawn[1] if len(drawn) > 1 else None
        sampler, random = self.model.sampler, self.streams["samples"]
        self.computing = "the model"
        with self.watch.stage("sampling"):
            if self.error_map:
                known = 0 if distances is None else len(distances)
                last = len(numbers) - round(self.train.error_rays * (len(numbers) - known))
                numbers[last:] = self.error_map.draw(len(numbers) - last, random)
            rays, pixels = self.table.batch(numbers, self.model.cameras)
        # While a step is recorded, `self.step` refuses to be read. A sampler that says its phases may read the number:
        # each graph is of one phase.
        step = self.step if sampler.phase(self._number) is None else self._number
        rendering, sampled, behind = self.model(
            rays, background=self.background, step=step, watch=self.watch, generator=random
        )
        with self.watch.stage("render"):
            target = composite(pixels, behind)
            if self.error_map:
                self.error_map.add(numbers, rendering.color, target)
            return self.loss_terms(rendering, sampled, target, distances)

    def loss_terms(
        self, rendering: Rendering, sampled: SampledRays, target: Tensor, distances: Tensor | None = None
    ) -> dict[str, Tensor]:
        """The weighted terms of `qnerf.training.terms`; their sum is minimised. `target` (R, 3): true colours."""
        step = Step(rendering, sampled, target, self.model, self.step, self.logged, distances)
        terms = {}
        for name, weight in self.weights.items():
            self.computing = f"the loss term {name}"
            term = LOSSES.get(name)(step)
            if term is not None:
                terms[name] = weight * term
        return terms

    @torch.no_grad()
    def validate(self) -> float:
        """PSNR in dB of the training rays that are held out for validation, rendered as in evaluation."""
        start = self.watch.now()
        background = evaluation_background(self.background)
        rays, pixels = self.table.validation(self.validation_rays, self.model.cameras)
        self.model.eval()
        self.watch.begin(measure=False)
        errors = []
        for first in range(0, len(rays), self.train.chunk):
            chunk = slice(first, first + self.train.chunk)
            rendering, _, behind = self.model(rays[chunk], background=background, step=self.step, watch=self.watch)
            errors.append((rendering.color - composite(pixels[chunk], behind)).square())
        self.model.train()
        seconds = self.watch.now() - start
        self.step_seconds[-1] += seconds
        self.seconds += seconds
        return decibels(float(torch.cat(errors).mean()))
