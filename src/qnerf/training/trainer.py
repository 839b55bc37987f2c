"""The training loop: batches of rays, the loss, the optimiser, checkpoints."""

import math
import time
from collections.abc import Callable, Iterator
from typing import Any, Protocol

import torch
from torch import Tensor

from qnerf.config.settings import Settings, Train
from qnerf.geometry.rays import RayTable
from qnerf.model.model import Model
from qnerf.model.occupancy import Occupancy
from qnerf.rendering.samplers import SampledRays
from qnerf.timing import PARTS, Stopwatch
from qnerf.training.losses import distortion, interlevel, mse
from qnerf.training.stopping import Plateau
from qnerf.types import Rendering

ADVICE = "the same command with numerics.check=true goes on from the last checkpoint and tells where that arises"


class Diverged(RuntimeError):
    """The loss or a parameter is no longer finite."""


class Checkpoints(Protocol):
    """Where a trainer's state is kept."""

    def save_checkpoint(self, state: dict[str, Any]) -> None: ...


def learning_rate(step: int, train: Train) -> float:
    """lr (lr_final / lr)^(step / steps)."""
    return train.lr * (train.lr_final / train.lr) ** (step / train.steps)


class Trainer:
    """Takes training steps; everything it depends on is in `state()`, so a resumed run repeats an uninterrupted one.

    Args:
        model: on its device, in its dtype.
        table: the training pixels and their rays.
        settings: budget, bounds, background.
        watch: times the parts of a step.
    """

    def __init__(self, model: Model, table: RayTable, settings: Settings, watch: Stopwatch) -> None:
        self.model = model
        self.table = table
        self.train = settings.train
        self.background = settings.render.background
        self.watch = watch
        self._at(0)
        self.step_seconds: list[float] = []
        self.seconds = 0.0  # in training steps, over all resumptions
        stop = settings.stop
        self.plateau = Plateau(stop.every, stop.patience, stop.min_gain_db)
        self.validation_rays = stop.rays
        device = settings.torch_device
        groups = [{"params": parameters, "name": name} for name, parameters in model.parts.items() if parameters]
        self.optimiser = torch.optim.Adam(groups, lr=self.train.lr, eps=self.train.eps, fused=True)
        # Separate streams: configurations that draw differently along the rays still see the same batches of rays.
        self.streams = {
            "pixels": torch.Generator().manual_seed(settings.seed),
            "samples": torch.Generator(device).manual_seed(settings.seed + 1),
        }

    def _at(self, step: int) -> None:
        self.step = step
        self.model.field.encoder.progress = step / self.train.steps

    def take_step(self, measure: bool) -> dict[str, float]:
        """One optimisation step; its metrics if `measure`, else nothing.

        Raises:
            Diverged: at the first loss that is not finite, naming the step and the part.
        """
        start = self.watch.now()
        self.watch.begin(watch=measure)
        rate = learning_rate(self.step, self.train)
        for group in self.optimiser.param_groups:
            group["lr"] = rate * self.train.rates[group["name"]]
        with self.watch.part("sampling"):
            mask = self.model.field.mask
            if isinstance(mask, Occupancy) and mask.due(self.step):
                mask.look(self.model.field, self.streams["samples"])
            rays, pixels = self.table.batch(self.train.rays, self.streams["pixels"], self.model.cameras)
        rendering, sampled, behind = self.model(
            rays, background=self.background, step=self.step, watch=self.watch, generator=self.streams["samples"]
        )
        with self.watch.part("render"):
            terms = self.loss_terms(rendering, sampled, composite(pixels, behind))
            loss = torch.stack(list(terms.values())).sum()
            value = float(loss.detach())
        if not math.isfinite(value):
            raise Diverged(f"the loss is {value} at step {self.step}, {self._blame(terms)}; {ADVICE}")
        with self.watch.part("backward"):
            self.optimiser.zero_grad(set_to_none=True)
            loss.backward()
        with self.watch.part("optimiser"):
            self.optimiser.step()
        self._at(self.step + 1)
        seconds = self.watch.now() - start
        self.step_seconds.append(seconds)
        self.seconds += seconds
        if not measure:
            return {}
        error = float(terms["mse"].detach())
        return {
            "train/loss": value,
            "train/psnr": -10 * math.log10(max(error, 1e-12)),
            **{f"train/{name}": float(term.detach()) for name, term in terms.items()},
            "train/lr": rate,
            "time/step_ms": seconds * 1e3,
            **{f"time/{name}_ms": self.watch.seconds[name] * 1e3 for name in PARTS},
        }

    def loss_terms(self, rendering: Rendering, sampled: SampledRays, target: Tensor) -> dict[str, Tensor]:
        """What is minimised is their sum. target: (R, 3)."""
        terms = {"mse": mse(rendering.color, target)}
        if self.train.distortion:
            terms["distortion"] = self.train.distortion * distortion(sampled.samples, rendering.weights)
        if self.train.interlevel and sampled.proposals:
            terms["interlevel"] = self.train.interlevel * interlevel(
                sampled.samples, rendering.weights, sampled.proposals
            )
        penalty = self.model.cameras.penalty()
        if penalty is not None:
            terms["poses"] = penalty
        return terms

    def _blame(self, terms: dict[str, Tensor]) -> str:
        """The part in which the first value that is not finite arose."""
        for name, parameters in self.model.parts.items():
            if not all(bool(torch.isfinite(p).all()) for p in parameters):
                return f"in the parameters of {name!r}"
        bad = [name for name, term in terms.items() if not math.isfinite(float(term.detach()))]
        return f"in the loss term {bad[0]!r}" if bad else "in the sum of the loss terms"

    def finite(self) -> bool:
        """Whether every parameter is finite."""
        return all(bool(torch.isfinite(p).all()) for p in self.model.parameters())

    def state(self) -> dict[str, Any]:
        """Everything the next step depends on."""
        return {
            "step": self.step,
            "model": self.model.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "streams": {name: stream.get_state() for name, stream in self.streams.items()},
            "torch_random": torch.get_rng_state(),
            "plateau": self.plateau.state(),
            "step_seconds": torch.tensor(self.step_seconds, dtype=torch.float64),
        }

    def load(self, state: dict[str, Any]) -> None:
        """Goes on from what `state` gave; ValueError where that was another model's."""
        try:
            self._at(state["step"])
            self.model.load_state_dict(state["model"])
            self.optimiser.load_state_dict(state["optimiser"])
            for name, stream in self.streams.items():
                given = state["streams"][name].cpu()
                if len(given) == len(stream.get_state()):
                    stream.set_state(given)
                else:  # of another kind of device, whose random numbers are others anyway
                    stream.manual_seed(stream.initial_seed() + self.step)
            torch.set_rng_state(state["torch_random"].cpu())
            self.plateau.load(state["plateau"])
            self.step_seconds = state["step_seconds"].tolist()
        except (KeyError, TypeError, RuntimeError) as error:
            raise ValueError("the checkpoint does not fit this run's model") from error
        self.seconds = sum(self.step_seconds)

    @property
    def done(self) -> bool:
        """Whether there is nothing left to train: the last step was taken, or the validation rays no longer gain."""
        return self.step >= self.train.steps or self.plateau.reached

    @torch.no_grad()
    def validate(self) -> float:
        """PSNR in dB of the training rays that are kept apart, rendered as in evaluation."""
        start = self.watch.now()
        background = "white" if self.background == "random" else self.background
        rays, pixels = self.table.validation(self.validation_rays, self.model.cameras)
        self.model.eval()
        self.watch.begin(watch=False)
        errors = []
        for first in range(0, len(rays), self.train.chunk):
            part = slice(first, first + self.train.chunk)
            rendering, _, behind = self.model(rays[part], background=background, step=self.step, watch=self.watch)
            errors.append((rendering.color - composite(pixels[part], behind)).square())
        self.model.train()
        seconds = self.watch.now() - start
        self.step_seconds[-1] += seconds
        self.seconds += seconds
        return -10 * math.log10(max(float(torch.cat(errors).mean()), 1e-12))

    def steps(self, store: Checkpoints, stopping: Callable[[], bool]) -> Iterator[dict[str, float]]:
        """Trains until it is done, yielding each step's metrics; checkpoints by the clock, at a stop and at the end.

        A state that is not finite is never saved: the last good checkpoint stays.
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
                self.save(store)
                saved = time.monotonic()
        self.save(store)

    def save(self, store: Checkpoints) -> None:
        if not self.finite():
            raise Diverged(f"a parameter is not finite after step {self.step - 1}, {self._blame({})}; {ADVICE}")
        store.save_checkpoint(self.state())


def composite(pixels: Tensor, behind: Tensor | None) -> Tensor:
    """Straight-alpha pixels (R, 4) over the colour (R, 3) behind them; pixels (R, 3) are opaque as they are."""
    if pixels.shape[-1] == 3:
        return pixels
    if behind is None:
        raise ValueError(
            "the images have alpha, which render.background=last_sample cannot be compared with; "
            "use render.background=white, black or random"
        )
    alpha = pixels[:, 3:]
    return pixels[:, :3] * alpha + behind * (1 - alpha)
