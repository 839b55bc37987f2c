"""The trials of a search, read from the runs of a store.

A run belongs to a trial if its id is the one that the trial's configuration has. So it does not matter who trained it:
runs of an earlier search or sweep count.
"""

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

NO_VALUE = "no number for {} in the summary"


class History:
    """Reads the trials of a space.

    store: folder of runs; it need not exist. ids: the runs of a point, one a seed; ValueError if its configuration is
        not valid. defaults: option -> its value in a run whose command does not name it.
    """

    def __init__(
        self,
        space: Space,
        objectives: Sequence[str],
        store: Path,
        ids: Callable[[Point], Sequence[str]],
        defaults: Mapping[str, str],
    ) -> None:
        self.space, self.objectives, self.store, self.defaults = space, list(objectives), store, dict(defaults)
        self.rejected: dict[Point, str] = {}
        self._ids = ids
        self._known_ids: dict[Point, tuple[str, ...]] = {}
        self._points: dict[str, Point | None] = {}  # of the runs that were looked at

    def ids(self, point: Point) -> tuple[str, ...]:
        """The runs of a point. A point whose configuration is not valid has no runs and is rejected."""
        if point not in self._known_ids:
            try:
                self._known_ids[point] = tuple(self._ids(point))
            except ValueError as error:
                self.reject(point, str(error))
        return self._known_ids.get(point, ())

    def result(self, point: Point) -> Hashable:
        """Equal for points whose runs are the same, because they differ in options that do not act."""
        return self.ids(point) or point

    def reject(self, point: Point, reason: str) -> None:
        """The point failed without a run in the store. reason: empty if it was told already."""
        self.rejected[point] = reason
        self._known_ids[point] = ()

    def trials(self) -> list[Trial]:
        """Those with a run in the store, in the order of their first runs, then the rejected ones."""
        columns = ["run_id", "state", "error", "stopped", "created", "path", *goals.columns(self.objectives)]
        rows: dict[str, Mapping[Any, Any]] = {}
        if self.store.is_dir() and len(frame := index.load(self.store, columns)):
            ordered = frame.sort_values(["created", "run_id"])
            rows = {row["run_id"]: row for row in ordered.to_dict("records")}
        found: dict[Hashable, Point] = {}
        for name, row in rows.items():
            if name not in self._points:
                self._points[name] = self._point(Path(row["path"]))
            point = self._points[name]
            if point is not None and name in self.ids(point):
                found.setdefault(self.result(point), point)
        rejected = [Trial(point, "failed", error=reason) for point, reason in self.rejected.items()]
        return [self._trial(point, rows) for point in found.values()] + rejected

    def _point(self, run: Path) -> Point | None:
        """The point whose overrides a run was started with; None if it is outside the space."""
        try:
            lines = read_overrides(run / "overrides.txt")
        except (OSError, StoreError):
            return None
        typed = self.defaults | {key: value for key, _, value in (line.partition("=") for line in lines)}
        texts = [values.find(typed[option]) if option in typed else None for option, values in self.space.items()]
        return None if None in texts else tuple(map(str, texts))

    def _trial(self, point: Point, rows: Mapping[str, Mapping[Any, Any]]) -> Trial:
        names = self.ids(point)
        runs: list[Mapping[Any, Any]] = [rows.get(name, {}) for name in names]
        states = [run.get("state") for run in runs]
        if "failed" in states:
            return Trial(point, "failed", runs=names, error=str(runs[states.index("failed")].get("error")))
        pruned = [run for run in runs if run.get("stopped") == PRUNED and run["state"] == "interrupted"]
        if pruned:
            metric = goals.judged(self.objectives)
            return Trial(point, "pruned", runs=names, curve=curve(Path(pruned[0]["path"]), metric) if metric else {})
        if set(states) != {"finished"}:
            return Trial(point, "unfinished", runs=names, running="running" in states)
        values: list[float] = []
        for name in self.objectives:
            measured = [value for run in runs if (value := goals.value(run, name)) is not None and np.isfinite(value)]
            if len(measured) < len(runs):
                return Trial(point, "failed", runs=names, error=NO_VALUE.format(name))
            values.append(float(np.mean(measured)))
        return Trial(point, "finished", tuple(values), names)


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
