"""The answers to a live page, as plain values for JSON; how they travel is in `app.py`."""

import io
import secrets
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from PIL import Image

import qnerf
from qnerf.metrics import metric_of
from qnerf.records import filters, read_config

from ..images import panels, pictures
from ..load import metrics
from ..report import content, curves
from ..report.pictures import Pictures
from ..report.tables import ShownTable, decisions
from ..report.verdicts import verdicts
from ..selection import main_metric, row_keys, select
from ..tables import ablation
from .store import WatchedStore

PREVIEW = "preview.png"
POINTS = 400  # of a curve, at most
MAX_RUNS = 400  # runs of one question for curves


class Answers:
    """What a live page asks of a store. All methods may be called from several threads.

    Raises:
        ValueError: a run, view or column is unknown, or a file of a run is damaged; OSError where it cannot be read.
    """

    def __init__(self, store: WatchedStore, title: str = "Runs") -> None:
        self.store = store
        self._title = title
        self._boot = secrets.token_hex(4)  # versions of an earlier server mean nothing

    def page(self) -> dict[str, Any]:
        """The values of the page's template."""
        version, frame = self.store.frame()
        return {
            "live": True,
            "title": self._title,
            "store": str(self.store.folder),
            "version": qnerf.__version__,
            "sections": SECTIONS,
            "verdicts": verdicts(frame) if len(frame) else None,
            "decisions": decisions(self.store.folder),
            "data": _data(frame) | {"version": f"{self._boot}-{version}"},
        }

    def changes(self, since: str) -> dict[str, Any]:
        """The table of runs as it is now, unless a page of version `since` has it.

        {"reload": true} where the version is of an earlier server.
        """
        if since.partition("-")[0] != self._boot:
            return {"reload": True}
        if since == f"{self._boot}-{self.store.version()}":
            return {"version": since}
        version, frame = self.store.frame()
        return {"version": f"{self._boot}-{version}", "data": _data(frame)}

    def keys(self, runs: Iterable[str]) -> dict[str, str]:
        """What any of these runs has logged: key -> heading."""
        found = (key for run in list(runs)[:MAX_RUNS] for key in self._logged(run))
        return {key: metric_of(key).heading for key in curves.arranged(found)}

    def curves(self, runs: Iterable[str], key: str) -> dict[str, Any]:
        """Run -> step, time (seconds) and value of one key, for the runs that have logged it."""
        found = {run: self._logged(run).get(key) for run in list(runs)[:MAX_RUNS]}
        return {run: curve for run, curve in found.items() if curve is not None}

    def views(self, run: str) -> dict[str, Any]:
        """Pictures of a run: view -> panel -> where it is, with width and height in pixels; `preview`, see `picture`.

        A damaged picture is left out.
        """
        folder = self.store.path(run)
        found = {}
        for view, path in pictures(folder).items():
            try:
                panels = _panels(path, _stamp(path))
            except (ValueError, OSError):
                continue
            found[view] = {name: {"width": part.shape[1], "height": part.shape[0]} for name, part in panels.items()}
        stamp = _stamp(folder / PREVIEW)
        return {"views": found, "preview": stamp}

    def picture(self, run: str, view: str, panel: str) -> tuple[bytes, str]:
        """One panel of a held-out view as WebP; or the whole `preview.png` of a run that trains, as panel `preview`."""
        folder = self.store.path(run)
        if panel == "preview":
            return (folder / PREVIEW).read_bytes(), "image/png"
        path = pictures(folder).get(view)
        panels = {} if path is None else _panels(path, _stamp(path))
        if panel not in panels:
            raise ValueError(f"{run}: no picture {view:.100}, {panel:.20}")
        data = io.BytesIO()
        Image.fromarray(panels[panel]).save(data, "WEBP", lossless=True, quality=20)
        return data.getvalue(), "image/webp"

    def differences(self, filter: str, rows: str, baseline: str, metric: str, within: str = "") -> ShownTable:
        """Rows over seeds, with their differences from the baseline, as `qnerf tables` makes them.

        filter, baseline: as `qnerf.records.filters` reads them. rows: columns between commas; empty for the settings
        that differ. within: the smallest difference that matters, as a number; empty for the metric's own.
        """
        _, frame = self.store.frame()
        if frame.empty:
            raise ValueError("there are no runs yet")
        chosen = filters.require(frame, filter) if filter.strip() else frame
        metric = metric or main_metric(chosen)
        asked = [filters.check_column(key, chosen.columns) for key in rows.split(",") if key.strip()]
        keys = asked or row_keys(select(chosen, metric).runs)
        try:
            least = float(within) if within.strip() else None
        except ValueError:
            raise ValueError(f"within: expected a positive number, got {within!r:.40}") from None
        return ShownTable("", ablation(chosen, keys, metric=metric, baseline=baseline or None, within=least))

    def _logged(self, run: str) -> dict[str, Any]:
        folder = self.store.path(run)
        try:
            stamp = str([_stamp(path) for path in sorted((folder / "metrics").iterdir())])
        except OSError:
            return {}
        return _curves(folder, stamp)


def _data(frame: pd.DataFrame) -> dict[str, Any]:
    """What the page's script reads of the runs."""
    if frame.empty:
        frame = pd.DataFrame({name: [] for name in ("run_id", "state", "scene_name", "psnr")})
    return content.data(frame, Pictures(), {})


SECTIONS = (
    ("verdicts-section", "Verdicts"),
    ("training-section", "In training"),
    ("differences-section", "Differences"),
    ("curves-section", "Curves"),
    ("runs-section", "Runs"),
    ("compared-section", "Compare"),
    ("explore-section", "Explore"),
)


@lru_cache(maxsize=512)
def _curves(folder: Path, _stamp: str) -> dict[str, Any]:
    """Every logged key of a run, thinned; empty where nothing readable was logged."""
    try:
        logged = metrics(folder)
    except ValueError:
        return {}
    return {str(key): curves.thinned(part, POINTS) for key, part in logged.groupby("key")}


@lru_cache(maxsize=256)
def _panels(path: Path, _stamp: str | None) -> dict[str, np.ndarray]:
    return panels(path, signal="head" in read_config(path.parents[1]))


def _stamp(path: Path) -> str | None:
    """Tells versions of a file apart; None if it does not exist."""
    try:
        found = path.stat()
    except FileNotFoundError:
        return None
    return f"{found.st_mtime_ns}-{found.st_ino}"
