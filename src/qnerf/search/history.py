"""The trials of a search, read from the runs of a store.

A run belongs to a trial if its id is the one that the trial's configuration has. So it does not matter who trained it:
runs of an earlier search or sweep count.
"""

import contextlib
import functools
from collections.abc import Callable, Hashable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from qnerf.config.checks import is_number
from qnerf.records import StoreError, index, read_metrics
from qnerf.records.details import read_overrides
from qnerf.search import objectives as goals
from qnerf.search.space import Point, Space
from qnerf.search.study import Trial
from qnerf.training.stopping import PRUNED


class History:
    """Reads the trials of a space.

    store: folder of runs; it need not exist. ids: the runs of a point, one a seed; ValueError if its configuration is
        not valid. groups: config group -> the choice of a run whose command names none. alike: two points with the
        same value give the same result; only one of them is tried.
    """

    def __init__(
        self,
        space: Space,
        objectives: Sequence[str],
        store: Path,
        ids: Callable[[Point], Sequence[str]],
        groups: Mapping[str, str],
        alike: Callable[[Point], Hashable] = lambda point: point,
    ) -> None:
        self.space, self.objectives, self.store, self.groups = space, list(objectives), store, groups
        self.alike = functools.cache(alike)
        self.rejected: dict[Point, str] = {}
        self._ids = ids
        self._known_ids: dict[Point, tuple[str, ...]] = {}
        self._points: dict[str, Point | None] = {}  # of the runs that were looked at

    def ids(self, point: Point) -> tuple[str, ...]:
        """The runs of a point; none if its configuration is not valid, and the point is rejected."""
        if point not in self._known_ids:
            try:
                self._known_ids[point] = tuple(self._ids(point))
            except ValueError as error:
                self.reject(point, str(error))
        return self._known_ids.get(point, ())

    def reject(self, point: Point, reason: str) -> None:
        """The point failed without a run in the store. reason: empty if it was told already."""
        self.rejected[point] = reason
        self._known_ids[point] = ()

    def trials(self) -> list[Trial]:
        """Those with a run in the store, in the order of their first runs, then the rejected ones."""
        options = [option for option in self.space if option not in self.groups]
        columns = ["run_id", "state", "error", "stopped", "created", "path", *goals.columns(self.objectives), *options]
        rows: dict[str, Mapping[Any, Any]] = {}
        if self.store.is_dir() and len(frame := index.load(self.store, columns)):
            ordered = frame.sort_values(["created", "run_id"])
            rows = {row["run_id"]: row for row in ordered.to_dict("records")}
        found: dict[Point, None] = {}
        for name, row in rows.items():
            if name not in self._points:
                self._points[name] = self._point(row)
            point = self._points[name]
            if point is not None and name in self.ids(point):
                found[point] = None
        rejected = [Trial(point, "failed", error=reason) for point, reason in self.rejected.items()]
        return [self._trial(point, rows) for point in found] + rejected

    def _point(self, row: Mapping[Any, Any]) -> Point | None:
        """The point that a run would have; None if it is outside the space."""
        typed = dict(self.groups)
        if typed:
            with contextlib.suppress(OSError, StoreError):
                lines = read_overrides(Path(row["path"]) / "overrides.txt")
                typed |= {key: value for key, _, value in (line.partition("=") for line in lines) if key in typed}
        texts = [values.find(typed.get(option, row.get(option))) for option, values in self.space.items()]
        return None if any(text is None for text in texts) else tuple(map(str, texts))

    def _trial(self, point: Point, rows: Mapping[str, Mapping[Any, Any]]) -> Trial:
        names = self.ids(point)
        runs: list[Mapping[Any, Any]] = [rows.get(name, {}) for name in names]
        states = [run.get("state") for run in runs]
        running = "running" in states
        if "failed" in states:
            return Trial(point, "failed", runs=names, error=str(runs[states.index("failed")].get("error")))
        pruned = [run for run in runs if run.get("stopped") == PRUNED and run["state"] == "interrupted"]
        if pruned:
            return Trial(point, "pruned", runs=names, curve=self._curve(pruned[0]))
        if set(states) != {"finished"}:
            return Trial(point, "unfinished", runs=names, running=running)
        measured = [[goals.value(run, name) for run in runs] for name in self.objectives]
        for name, values in zip(self.objectives, measured, strict=True):
            if not all(value is not None and np.isfinite(value) for value in values):
                return Trial(point, "failed", runs=names, error=f"no number for {name} in the summary")
        return Trial(point, "finished", tuple(float(np.mean(values)) for values in measured), names)  # type: ignore[arg-type]

    def _curve(self, run: Mapping[Any, Any]) -> dict[int, float]:
        judged = goals.judged(self.objectives)
        return curve(Path(run["path"]), judged) if judged else {}


def curve(run: Path, metric: str) -> dict[int, float]:
    """Step -> the metric of a run's evaluations; empty if they cannot be read."""
    try:
        logged = read_metrics(run)
    except StoreError:
        return {}
    rows = logged[logged["key"] == f"eval/{metric}"]
    return {
        int(step): float(value) for step, value in zip(rows["step"], rows["value"], strict=True) if is_number(value)
    }
