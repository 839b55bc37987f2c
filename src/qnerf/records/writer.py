"""The writer of one run. Everything that it writes is readable at any moment and survives kill -9.

Rows of metrics collect in memory. A thread writes them every few seconds, together with the heartbeat. Each time it
replaces the open part by a longer one, so there is nothing to compact or to repair. If the thread fails, the next call
of `log` raises its error.
"""

import atexit
import contextlib
import io
import json
import logging
import threading
import time
from array import array
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from qnerf.config.identity import plain
from qnerf.records import schemas, summary_row
from qnerf.records.checkpoints import Checkpoints
from qnerf.records.environment import MAX_FILE_BYTES, environment_files
from qnerf.records.files import (
    StoreError,
    delete,
    exists,
    make_folder,
    open_plain,
    preserve,
    read_bytes,
    replace,
    reporting,
)
from qnerf.records.live_parquet import appended, encode, rewritten
from qnerf.records.numbered import PARTS
from qnerf.records.owner import HEARTBEAT_INTERVAL, Ownership, Process
from qnerf.records.read import read_config, read_part, read_status, read_summary, read_table_bytes

FORMAT = 1  # of the store; runs in a newer format are read as far as possible, but not written
PART_ROWS = 65_536
EMPTY_PART = encode(schemas.METRICS_SCHEMA.empty_table())

_log = logging.getLogger("qnerf")


def running_status(ownership: Ownership) -> dict[str, Any]:
    """What status.json says about the owner while it writes the run."""
    state = {"state": "running", "claim": ownership.nonce, "error": None, "format": FORMAT}
    return asdict(Process.current()) | state


class Run:
    """Writes into a run's folder; `RunStore.claim` makes it.

    As a context manager it ends the run in any case: after Ctrl-C, or without a call of `finish`, as interrupted; after
    another error as failed. If `resumed` is true there was something before, and `resume` must be called before `log`.
    """

    def __init__(self, ownership: Ownership, *, resumed: bool, every: float = HEARTBEAT_INTERVAL) -> None:
        self.dir = ownership.directory
        self.run_id = self.dir.name
        self.resumed = resumed
        self.config = read_config(self.dir)
        self._ownership = ownership
        self._checkpoints = Checkpoints(self.dir, ownership.check, self.warn)
        self._status: dict[str, Any] = {"step": 0, "created": time.time()} | read_status(self.dir)
        self._status |= running_status(ownership)
        self._results = schemas.results(read_summary(self.dir), self.config)
        step = self._status["step"]
        self._step = step if isinstance(step, int) else 0
        self._accepts_rows = not resumed
        self._closed = self._stopping = False

        self._lock = threading.Lock()  # for the buffers; held for microseconds
        self._io = threading.RLock()  # for the files
        self._steps, self._times, self._values = array("q"), array("d"), array("d")  # rows that are not on disk yet
        self._key_numbers = array("i")
        self._columns = (self._steps, self._times, self._key_numbers, self._values)
        self._keys: dict[str, int] = {}  # name -> its number
        self._part_data = b""
        self._open_part(0, 0)
        self._tables = {name: read_table_bytes(self.dir / name) for name in ("eval.parquet", "summary.parquet")}

        self._error: StoreError | None = None
        self._wake = threading.Event()
        self._write_status()
        self.write_summary({"state": "running", "error": None})
        self._thread = threading.Thread(
            target=self._write_regularly, args=(every,), name=f"qnerf-{self.run_id}", daemon=True
        )
        self._thread.start()
        # If a thread is inside a C library when the interpreter ends, the process can crash.
        atexit.register(self._stop)

    # Rows of metrics

    def log(self, step: int, time_s: float, values: Mapping[str, float]) -> None:
        """One row per value. step: training step, from 0. time_s: seconds of training so far.

        Raises:
            ValueError: a value is not a number; no row is logged then.
            StoreError: an earlier row could not be written.
        """
        assert self._accepts_rows, "a resumed run logs only after resume(step)"
        assert not self._closed, "the run has ended"
        if self._error is not None:
            raise self._error
        step, time_s = int(step), float(time_s)
        rows = [(key, _number(key, value)) for key, value in values.items()]
        with self._lock:
            for key, value in rows:
                self._steps.append(step)
                self._times.append(time_s)
                self._key_numbers.append(self._keys.setdefault(key, len(self._keys)))
                self._values.append(value)  # last: its length counts if Ctrl-C comes in between
            self._step = step
            full = len(self._values) >= PART_ROWS
        if full:
            self._wake.set()

    def flush(self) -> None:
        """Returns when all rows so far are on disk."""
        with self._io:
            while True:
                with self._lock:
                    rows = min(len(self._values), PART_ROWS - self._part_rows)
                    if rows == 0:
                        return
                    columns = [column[:rows] for column in self._columns]
                    keys = list(self._keys)
                self._ownership.check()
                data = appended(self._part_data, _metrics_table(keys, *columns))
                self._write_part(self._part, data)
                self._part_data = data
                self._part_rows += rows
                with self._lock:
                    for column in self._columns:
                        del column[:rows]
                if self._part_rows == PART_ROWS:
                    self._open_part(self._part + 1, 0)

    def resume(self, step: int) -> None:
        """Drops all rows after `step`, the step of the checkpoint from which training goes on; -1 drops all rows.

        A damaged part is copied beside metrics/ with a warning. Its rows are lost; those of other parts stay.
        """
        with self._io:
            self._ownership.check()
            last = rows = 0
            parts = PARTS.in_folder(self.dir / "metrics")
            if missing := [PARTS.name(number) for number in range(max(parts, default=0)) if number not in parts]:
                self.warn(f"{self.dir / 'metrics'}: {', '.join(missing[:3])} is missing; its rows are lost")
            for number, path in parts.items():
                table = self._read_or_set_aside(number, path)
                remaining = table.filter(pc.less_equal(table["step"], step))
                # The part is emptied, not removed: a reader may just have listed the folder and must find every file.
                if remaining.num_rows < table.num_rows:
                    self._write_part(number, rewritten(self._read_part(number), partial(encode, remaining)))
                if remaining.num_rows:
                    full = remaining.num_rows >= PART_ROWS
                    last, rows = (number + 1, 0) if full else (number, remaining.num_rows)
            self._open_part(last, rows)
            self._step = max(step, 0)
            self._accepts_rows = True
            self._write_status()

    def _read_or_set_aside(self, number: int, path: Path) -> pa.Table:
        try:
            return read_part(path)
        except StoreError as error:
            aside = self.dir / f"damaged-{time.time_ns()}-{path.name}"
            with reporting(path):
                preserve(path, aside)
            self._write_part(number, EMPTY_PART)
            self.warn(f"{error}; set aside as {aside.name}, its rows are missing from now on")
            return schemas.METRICS_SCHEMA.empty_table()

    def _open_part(self, number: int, rows: int) -> None:
        """New rows go to part `number`, which has `rows` of them."""
        self._part, self._part_rows, self._part_data = number, rows, self._read_part(number)

    def _read_part(self, number: int) -> bytes:
        path = self._part_path(number)
        return read_table_bytes(path) if exists(path) else EMPTY_PART

    def _part_path(self, number: int) -> Path:
        return self.dir / "metrics" / PARTS.name(number)

    def _write_part(self, number: int, data: bytes) -> None:
        # No temporary file in metrics/: a reader must not list a file that is gone when it opens it.
        self._replace(self._part_path(number), data, temporary_folder=self.dir)

    # Tables, pictures and texts

    def write_eval(self, rows: Iterable[Mapping[str, Any]]) -> None:
        """eval.parquet: one row per evaluated image, with at least `image`; the step is the last one logged.

        Columns psnr, ssim, lpips, lpips_reason, depth_error always exist; others are float64 or text.
        """
        with self._io:
            self._rewrite("eval.parquet", partial(encode, schemas.evaluation(rows, self._step)))

    def write_summary(self, results: Mapping[str, Any]) -> None:
        """Adds results to the one row of summary.parquet; results with other names stay."""
        with self._io:
            self._results |= plain(results, "summary")
            row = schemas.summary(self._results | {"run_id": self.run_id}, self.config)
            self._rewrite("summary.parquet", partial(summary_row.encode, row))

    def _rewrite(self, name: str, encode_between: Callable[[bytes, bytes], bytes]) -> None:
        data = rewritten(self._tables[name], encode_between)
        self._write(name, data)
        self._tables[name] = data

    def write_environment(self, environment: Mapping[str, Any], diff: str = "") -> None:
        """environment.json and, if the code differs from its commit, dirty.diff.

        A resumed run keeps the first ones. If its environment differs, it adds environment-2.json and so on.
        """
        data = (json.dumps(plain(environment, "environment"), indent=1) + "\n").encode()
        for path, patch in environment_files(self.dir):
            if not exists(path):
                if diff:
                    self._write(patch.name, diff.encode())
                self._write(path.name, data)
                return
            known_diff = read_bytes(patch, MAX_FILE_BYTES) if exists(patch) else b""
            if read_bytes(path, MAX_FILE_BYTES) == data and known_diff == diff.encode():
                return

    def write_transform(self, similarity: np.ndarray) -> None:
        """dataparser_transforms.json, as nerfstudio writes it: how the source's world became the normalised one.

        `transform` is a rigid motion (3, 4), which comes first, and `scale` the factor after it.
        similarity: (4, 4).
        """
        scale = float(np.cbrt(np.linalg.det(similarity[:3, :3])))
        content = {"transform": (similarity[:3] / scale).tolist(), "scale": scale}
        self._write("dataparser_transforms.json", (json.dumps(content, indent=1) + "\n").encode())

    def save_image(self, name: str, image: np.ndarray) -> None:
        """images/<name>.png from (H, W), (H, W, 3) or (H, W, 4) uint8."""
        if not name or Path(name).name != name or name.startswith("."):
            raise ValueError(f"picture: expected a plain file name, got {name!r}")
        file = name if name.endswith(".png") else f"{name}.png"
        data = _png(image)
        with self._io:
            self._ownership.check()
            with reporting(self.dir / "images"):
                make_folder(self.dir / "images")
            self._replace(self.dir / "images" / file, data, temporary_folder=self.dir, durable=False)

    def save_preview(self, image: np.ndarray) -> None:
        """preview.png, the state of a view while the run trains."""
        data = _png(image)
        with self._io:
            self._ownership.check()
            self._replace(self.dir / "preview.png", data, durable=False)

    def text_log(self, line: str) -> None:
        """Appends the local time and the line to log.txt."""
        path = self.dir / "log.txt"
        text = f"{time.strftime('%Y-%m-%d %H:%M:%S')} {' '.join(line.splitlines())}\n"
        with self._io, reporting(path), open_plain(path, "ab") as file:
            file.write(text.encode())

    def warn(self, line: str) -> None:
        """Writes to log.txt and to the program's log (by default standard error)."""
        _log.warning(line)
        with contextlib.suppress(StoreError):
            self.text_log(f"warning: {line}")

    # Checkpoints

    def save_checkpoint(self, content: Mapping[str, Any]) -> None:
        """Flushes the rows, then writes checkpoint.pt; the one before becomes checkpoint.prev.pt.

        content: tensors and plain values that torch.load(weights_only=True) accepts; ValueError otherwise.
        """
        with self._io:
            self.flush()
            self._ownership.check()
            self._checkpoints.save(dict(content))

    def load_checkpoint(
        self, check: Callable[[dict[str, Any]], None] = lambda content: None, max_bytes: int | None = None
    ) -> dict[str, Any] | None:
        """The last checkpoint that can be read, with its tensors on the CPU; see `Checkpoints.load`."""
        with self._io:
            return self._checkpoints.load(check, max_bytes)

    # State

    def status(self, *, state: str = "running", step: int | None = None, error: str | None = None) -> None:
        """Writes status.json now; the thread writes it again with every heartbeat."""
        if self._error is not None:
            raise self._error
        with self._io:
            self._ownership.check()
            self._step = self._step if step is None else int(step)
            self._status |= {"state": state, "error": error}
            self._write_status()

    def finish(self, summary: Mapping[str, Any] | None = None) -> None:
        """The run is complete. The same command again will skip it."""
        self._end("finished", None, summary)
        delete(self.dir / "checkpoint.prev.pt", ignore_errors=True)

    def fail(self, error: str) -> None:
        self._end("failed", " ".join(error.split()))

    def interrupt(self) -> None:
        self._end("interrupted", None)

    def __enter__(self) -> "Run":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._closed:
            return
        if error is None:
            self.interrupt()
            return
        with contextlib.suppress(StoreError):  # the first error says more
            if isinstance(error, Exception):
                self.fail(str(error) or type(error).__name__)
            else:
                self.interrupt()

    def _end(self, state: str, error: str | None, summary: Mapping[str, Any] | None = None) -> None:
        """Writes rows, then the summary, then the state: a run that says "finished" is complete.

        What cannot be written does not keep the rest from being written, and ownership is released in any case.
        """
        if self._closed:
            return
        self._stop()
        problem = self._error
        try:
            try:
                if self._accepts_rows:
                    self.flush()
                self.write_summary({**(summary or {}), "state": state, "error": error})
            except StoreError as failure:
                problem = problem or failure
            if problem is not None:
                state, error = "failed", error or str(problem)
            self._status |= {"state": state, "error": error}
            self._ownership.check()
            self._write_status(durable=True)
            if problem is not None:
                raise problem
        finally:
            self._closed = True
            with contextlib.suppress(StoreError):
                self._ownership.release()

    def _write_regularly(self, every: float) -> None:
        while True:
            self._wake.wait(every)
            self._wake.clear()
            if self._stopping:
                return
            try:
                with self._io:
                    self._ownership.check()
                    self.flush()
                    self._write_status()
            except Exception as error:  # raised by the next log()
                known = isinstance(error, StoreError)
                self._error = error if known else StoreError(f"{self.dir}: cannot write: {error}")  # type: ignore
                return

    def _stop(self) -> None:
        self._stopping = True
        self._wake.set()
        self._thread.join(timeout=60)
        atexit.unregister(self._stop)

    def _write(self, name: str, data: bytes) -> None:
        with self._io:
            self._ownership.check()
            self._replace(self.dir / name, data)

    def _replace(self, path: Path, data: bytes, *, temporary_folder: Path | None = None, durable: bool = True) -> None:
        """The owner is checked last: a process may be stopped, or wait for a disk, for longer than its claim lasts."""

        def check(_: Path) -> None:
            self._ownership.check()

        replace(path, data, temporary_folder=temporary_folder, durable=durable, before_rename=check)

    def _write_status(self, durable: bool = False) -> None:
        with self._io:
            self._status |= {"run_id": self.run_id, "step": self._step, "heartbeat": time.time()}
            data = (json.dumps(self._status, indent=1) + "\n").encode()
            self._replace(self.dir / "status.json", data, durable=durable)


def _png(image: np.ndarray) -> bytes:
    from PIL import Image

    if image.dtype != np.uint8 or not (image.ndim == 2 or (image.ndim == 3 and image.shape[2] in (3, 4))):
        raise ValueError(f"picture: expected (H, W[, 3 or 4]) uint8, got {image.shape} {image.dtype}")
    data = io.BytesIO()
    Image.fromarray(image).save(data, format="PNG")
    return data.getvalue()


def _metrics_table(keys: Sequence[str], steps: array, times: array, key_numbers: array, values: array) -> pa.Table:
    """Rows of metrics from columns of equal length; `keys[key_numbers]` are the names."""
    names = pa.DictionaryArray.from_arrays(pa.array(np.asarray(key_numbers)), pa.array(keys, pa.string()))
    return pa.table(
        [pa.array(np.asarray(steps)), pa.array(np.asarray(times)), names, pa.array(np.asarray(values))],
        schemas.METRICS_SCHEMA.names,
    )


def _number(key: str, value: Any) -> float:
    try:
        if not isinstance(value, str):
            return float(value)
    except (TypeError, ValueError, RuntimeError):
        pass
    raise ValueError(f"log: {key} expects a number, got {value!r}")
