"""`qnerf.run`, `qnerf.sweep`, `qnerf.load` and `qnerf.runs`: the command line for notebooks and scripts.

The same checks, store and ids as `qnerf run`. No application of Hydra is started, and nothing ends the process.
"""

import base64
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from html import escape
from numbers import Integral
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import torch
from rich.console import Console

from qnerf.building.configuration import Configuration
from qnerf.cli import compose
from qnerf.cli.commands import runs as listing
from qnerf.cli.display import LiveDisplay, print_outcome
from qnerf.cli.errors import is_known, report
from qnerf.cli.stored import load_stored
from qnerf.cli.sweep import announce, combinations
from qnerf.cli.text import duration
from qnerf.cli.training import note_without_effect, train
from qnerf.metrics import shown_quality
from qnerf.records import filters, find, read_config, read_metrics, read_summary, state
from qnerf.records.read import read_evaluation
from qnerf.training.trainer import Diverged

if TYPE_CHECKING:
    from PIL.Image import Image

    from qnerf.geometry.camera_paths import Camera
    from qnerf.model.model import Model
    from qnerf.probes import Trained
    from qnerf.viewing.frames import Renderer

_turn = threading.RLock()  # one trains at a time: PyTorch's random stream and its threads are the process's
REFRESH = 0.2  # seconds between two changes of a notebook's progress bar
PICTURES = 2  # that a run shows of itself


@dataclass(frozen=True)
class StoredRun:
    """A run of the store. Everything is read from its folder when it is asked for.

    overrides: how to load its model, such as device=cpu, scene.path=DIR or plugins=[my_module].
    """

    path: Path
    overrides: tuple[str, ...] = ()

    @property
    def id(self) -> str:
        return self.path.name

    @property
    def state(self) -> str:
        """running, finished, interrupted, failed or damaged."""
        return state(self.path)

    @property
    def summary(self) -> dict[str, Any]:
        """Results, parameter counts, timings and the flat configuration."""
        return read_summary(self.path)

    @property
    def config(self) -> dict[str, Any]:
        return read_config(self.path)

    def metrics(self) -> pd.DataFrame:
        """Columns step, time_s (seconds of training), key and value, in the order of logging."""
        return read_metrics(self.path)

    def eval(self) -> pd.DataFrame:
        """One row a held-out view: `image`, `step` and its metrics."""
        return read_evaluation(self.path)

    @cached_property
    def trained(self) -> "Trained":
        """Scene, settings and model of the last checkpoint; ValueError for a signal, which is no radiance field."""
        return load_stored(self.path, self.overrides)

    @property
    def model(self) -> "Model":
        return self.trained.model

    @cached_property
    def _renderer(self) -> "Renderer":
        from qnerf.viewing.frames import Renderer

        return Renderer(self.trained)

    def render(self, camera: "int | Camera") -> "Image":
        """The picture from a view of the scene, by its number from 0, or from a `geometry.camera_paths.Camera`.

        Raises:
            ValueError: the scene has no such view.
        """
        from PIL import Image

        from qnerf.geometry.camera_paths import Camera
        from qnerf.viewing.frames import as_bytes

        last = len(self.trained.scene.names) - 1
        if isinstance(camera, Camera):
            seen: Any = self._renderer.frame(camera)
        elif isinstance(camera, Integral) and 0 <= camera <= last:
            seen = self._renderer.view(int(camera))
        else:
            raise ValueError(f"camera={camera!r}: expected the number of a view from 0 to {last}, or a Camera")
        return Image.fromarray(np.asarray(as_bytes(seen.color)))

    def pictures(self) -> list[Path]:
        """The pictures of the held-out views: truth, rendering, error and depth side by side."""
        return sorted((self.path / "images").glob("*.png"))

    def _repr_html_(self) -> str:
        """What a notebook shows: state, metrics and a few pictures."""
        summary = self.summary
        values = [f"{item.label} {item.with_unit(summary[item.key])}" for item in shown_quality(summary)]
        shown = [
            f'<figure style="margin:4px 0"><img style="max-width:100%" src="data:image/png;base64,'
            f'{base64.b64encode(picture.read_bytes()).decode()}"><figcaption>{escape(picture.stem)}</figcaption></figure>'
            for picture in self.pictures()[:PICTURES]
        ]
        return f"<b>{escape(self.id)}</b> {self.state}<br>{escape(', '.join(values))}{''.join(shown)}"


def run(*overrides: str) -> StoredRun:
    """Trains and evaluates one configuration, such as `qnerf.run("field=qcolor", "train.steps=500")`.

    A finished run is not trained again, and an interrupted one is continued. Interrupting the cell, or Ctrl-C, stops
    the training with a checkpoint.

    Raises:
        ValueError: a mistake in the options or the scene, in one line.
        Diverged: the loss turned NaN or infinite.
    """
    config = Configuration.of(compose.configuration(_without_several_values(overrides)))
    return _train(config, overrides, note_without_effect(config, overrides))


def sweep(*overrides: str) -> list[StoredRun]:
    """Trains every combination of the values, `qnerf.sweep("field=classical,qcolor", "seed=0,1")`, one after the other.

    A job that fails is reported on standard error, and its run is left out.

    Raises:
        ValueError: an option or a choice that does not exist, before anything is trained.
    """
    jobs = combinations([compose.parse(compose.translated(override)) for override in overrides])
    announce(jobs, compose.configuration)
    trained = []
    for job in jobs:
        print(" ".join(job))
        try:
            trained.append(_train(Configuration.of(compose.configuration(job)), job, brief=True))
        except Exception as error:
            if not (is_known(error) or isinstance(error, Diverged)):
                raise
            report(error)
            continue
        if trained[-1].state == "interrupted":
            break
    return trained


def load(run: str, *overrides: str, store: str | Path = "runs") -> StoredRun:
    """A run of the store.

    run: its folder (runs/ID), its id, or a part of its id that no other run has.
    overrides: see `StoredRun`.

    Raises:
        ValueError: no run or more than one, with the nearest ids.
    """
    return StoredRun(find(run, store).absolute(), overrides)


def runs(conditions: str = "", store: str | Path = "runs") -> pd.DataFrame:
    """One row a run, the newest first: results, parameter counts, timings, the flat configuration, state, path.

    conditions: as `qnerf runs` takes them, "field=qcolor seed=0,1 psnr>25".

    Raises:
        ValueError: a condition names a column that no run has.
    """
    wanted = filters.parse(conditions)
    frame = listing.load(str(store), [condition.key for condition in wanted], all_columns=True)
    return listing.arrange(filters.select(frame, wanted)) if len(frame) else frame


def _without_several_values(overrides: Sequence[str]) -> Sequence[str]:
    for override in overrides:
        if compose.parse(override).is_sweep_override():
            raise ValueError(f"{override}: several values are a sweep; use qnerf.sweep")
    return overrides


def _train(
    config: Configuration, overrides: Sequence[str], changed: Sequence[str] | None = None, brief: bool = False
) -> StoredRun:
    """changed: as `LiveDisplay` takes it."""
    notebook = _in_notebook()
    progress = config["run.progress"]
    kind: Callable[..., LiveDisplay] = NotebookDisplay if notebook and progress else LiveDisplay
    console = Console(force_jupyter=False, force_terminal=False if notebook else None)  # the bar is the display's
    with _turn, torch.random.fork_rng(devices=[]):
        threads = torch.get_num_threads()
        try:
            outcome = train(config, overrides, kind(console, progress, changed))
        finally:
            torch.set_num_threads(threads)
    print_outcome(console, outcome, brief=brief or notebook)
    same = tuple(override for override in overrides if override.lstrip("+").startswith("plugins="))
    return StoredRun(outcome.path.absolute(), same)


def _in_notebook() -> bool:
    """Whether this code runs in a notebook's kernel; a script that imports ipykernel has none."""
    shell = sys.modules["IPython"].get_ipython() if "IPython" in sys.modules else None
    return hasattr(shell, "kernel")


class NotebookDisplay(LiveDisplay):
    """The same in a notebook, where the bar is a piece of HTML that is replaced."""

    def begin(self, path: Path, step: int, steps: int) -> None:
        from IPython.display import display

        super().begin(path, step, steps)
        self.handle: Any = display({"text/plain": ""}, raw=True, display_id=True)
        self.refreshed = 0.0

    def step(self, step: int, metrics: Any) -> None:
        now = time.monotonic()
        if now - self.refreshed < REFRESH and step < self.steps:
            return
        self.refreshed = now
        text = f"{step}/{self.steps}  {duration(now - self.started)}  {self.status(metrics)}"
        bar = f'<progress value="{step}" max="{self.steps}"></progress> {escape(text)}'
        self.handle.update({"text/html": bar, "text/plain": text}, raw=True)
