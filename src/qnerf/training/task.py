"""`Task`: a scene, with what is trained on it and how the result is judged."""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, ClassVar, Protocol

import numpy as np
from torch import Tensor

from qnerf.config.settings import Common
from qnerf.timing import Stopwatch
from qnerf.training.trainer import Loop

Measures = dict[str, float | str | None]
"""Metric -> value; None if it cannot be computed."""


class ViewEvaluator(Protocol):
    """Measures and draws views of its scene."""

    scene: Any

    def views(self, views: list[int], step: int, rays: int | None = None) -> Iterator[tuple[Any, Measures]]: ...

    def preview(self, step: int) -> np.ndarray: ...

    def picture(self, rendered: Any) -> np.ndarray: ...


class Task(ABC):
    """One kind of scene: its options, model, training and evaluation. Posed images are trained by `FieldTask`.

    A subclass is registered in `SCENES`. Its keyword-only parameters are the user's options of the group `scene`.
    `build` comes before everything that needs a model.
    """

    options: ClassVar[type[Common]]
    """The dataclass of the options of a configuration with such a scene."""
    base: ClassVar[str] = ""
    """The file of conf/scene with what the configuration of such a scene has besides the group `scene`."""
    held_out: ClassVar[str] = "views"
    """What is held out; empty where the whole is one view."""

    brings_color: ClassVar[str] = "a lower train.lr"
    """Options that may mend a model which shows one colour, for the line that says so."""

    name: str
    fingerprint: str
    """Hash of what the scene is made from; the same on every machine."""
    headline: str
    """Key of the metric that is shown during training."""
    eval: Sequence[int]
    """Indices of the held-out views."""
    names: Sequence[str]
    """Of all views."""

    settings: Any
    model: Any
    """An `nn.Module` on the run's device, with `parts` (name -> parameters, see `train.rates`) and an `encoder`."""
    columns: Mapping[str, float] = {}
    """Further columns of the summary, known after `build`."""
    transform: Tensor | None = None
    """(4, 4) similarity from the source's world to the one that is trained in, to be kept with the run."""
    curve_views: int = 0
    """Held-out views that are evaluated during training; 0: all."""

    @property
    def scene(self) -> Any:
        """The data, as an evaluator shows it."""
        return self

    @property
    def tests_unseen(self) -> bool:
        """Whether results are measured on data that training does not see."""
        return True

    def validating(self, share: float) -> "Task":
        """The same with this share of what trains held out, which is measured instead of the test data.

        See `qnerf.scenes.base.hold_out`, which chooses it. ValueError where the kind has no such thing.
        """
        raise ValueError(f"scene.validation={share:g}: {type(self).__name__} has no method `validating`")

    def decide(self, configuration: Any) -> tuple[Any, Mapping[str, Any]]:
        """The `building.configuration.Configuration` that holds for this scene, and the options that were `auto`, each
        with its `auto.Decision`. ValueError where the data are not what the kind expects, or the options do not fit."""
        return configuration, {}

    @abstractmethod
    def description(self) -> str:
        """One line: how much there is to train on."""

    @abstractmethod
    def build(self, settings: Any) -> None:
        """Builds `model` and whatever else depends on the settings; ValueError where that is not possible."""

    @property
    @abstractmethod
    def points_a_step(self) -> int:
        """Points at which a step evaluates the model."""

    @abstractmethod
    def trainer(self, watch: Stopwatch) -> Loop: ...

    @abstractmethod
    def evaluator(self, watch: Stopwatch) -> ViewEvaluator: ...

    def notes(self) -> str:
        """What the start of a run says beside `description`."""
        return ""

    def doubts(self) -> list[str]:
        """What seems to be wrong with the data, a line each."""
        return []

    def rays_of(self, views: Sequence[int]) -> int:
        """Rays, or points, that an evaluation of these views takes; 0: next to none."""
        return 0
