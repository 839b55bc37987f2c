"""The writer of one run. Everything it writes is readable at any moment and survives kill -9.

Rows of metrics collect in memory; a thread writes them every few seconds, together with the heartbeat. The open part is
replaced by a longer one each time, so there is nothing to compact or to repair. What goes wrong in the thread is
raised by the next call of `log`.
"""

import atexit
import contextlib
import io
import json
import logging
import threading
import time
from array import array
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from qnerf.config.identity import flatten, plain
from qnerf.records import schemas
from qnerf.records.checkpoints import Checkpoints
from qnerf.records.files import StoreError, keep_copy, open_plain, read_bytes, replace, reporting
from qnerf.records.live_parquet import appended, encode, rewritten
from qnerf.records.owner import HEARTBEAT, Ownership, Process
from qnerf.records.read import MOST_TABLE_BYTES, read_config, read_part, read_status, read_summary
from qnerf.records.summary_row import encode as encode_row

FORMAT = 1  # of the store; a run of a newer one is read as far as it goes, and not written
PART_ROWS = 65_536
EMPTY_PART = schemas.encode(schemas.METRICS.empty_table())
MOST_DIFF_BYTES = 2**26

_log = logging.getLogger("qnerf")


class Run:
    """Writes into a run's folder; made by `RunStore.claim`. As a context manager it ends the run whatever happens:
    Ctrl-C leaves it interrupted, another error failed, and leaving the block without `finish` interrupted.

    `resumed` says whether there was something before; then `resume` must be called before `log`.
    """

    _part: int  # number of the open part; _part_rows, _part_data: what it holds
    _part_rows: int
    _part_data: bytes

    def __init__(self, ownership: Ownership, *, resumed: bool, every: float = HEARTBEAT) -> None:
        self.dir = ownership.directory
        self.run_id = self.dir.name
        self.resumed = resumed
        self.config = read_config(self.dir)
        self._ownership = ownership
        self._checkpoints = Checkpoints(self.dir, self._check, self.warn)
        self._status: dict[str, Any] = {"step": 0, "created": time.time()} | read_status(self.dir)
        self._status |= asdict(Process.current()) | {"state": "running", "claim": ownership.nonce, "error": None}
        self._status["format"] = FORMAT
        options = flatten(self.config)
        self._results = {k: v for k, v in read_summary(self.dir).items() if k in schemas.SUMMARY or k not in options}
        step = self._status["step"]
        self._step = step if isinstance(step, int) else 0
        self._ready = not resumed  # for rows
        self._closed = self._stopping = False

        self._lock = threading.Lock()  # the buffers; held for microseconds
        self._io = threading.RLock()  # the files
        self._steps, self._times, self._values = array("q"), array("d"), array("d")  # of rows that are not on disk yet
        self._indices = array("i")  # of their names in `_keys`
        self._columns = (self._steps, self._times, self._indices, self._values)
        self._keys: dict[str, int] = {}
        self._open_part(0, 0)
        self._eval_data = _bytes(self.dir / "eval.parquet")
        self._summary_data = _bytes(self.dir / "summary.parquet")

        self._error: StoreError | None = None
        self._wake = threading.Event()
        self._write_status()
        self.write_summary({"state": "running", "error": None})
        self._keeper = threading.Thread(target=self._keep, args=(every,), name=f"qnerf-{self.run_id}", daemon=True)
        self._keeper.start()
        # A thread that is inside a C library when the interpreter goes down can take the process with it.
        atexit.register(self._stop)

    # Rows of metrics

    def log(self, step: int, time_s: float, values: Mapping[str, float]) -> None:
        """One row a value. step: training step, from 0; time_s: seconds of training so far.

        Raises StoreError when an earlier row could not be written.
        """
        assert self._ready, "a resumed run logs only after resume(step)"
        assert not self._closed, "the run has ended"
        if self._error is not None:
            raise self._error
        step, time_s = int(step), float(time_s)
        rows = [(key, _number(key, value)) for key, value in values.items()]
        with self._lock:
            for key, value in rows:
                self._steps.append(step)
                self._times.append(time_s)
                self._indices.append(self._index(key))
                self._values.append(value)  # last: its length counts, should Ctrl-C come in between
            self._step = step
            full = len(self._values) >= PART_ROWS
        if full:
            self._wake.set()

    def flush(self) -> None:
        """All rows so far are on disk when this returns."""
        with self._io:
            while True:
                with self._lock:
                    rows = min(len(self._values), PART_ROWS - self._part_rows)
                    if rows == 0:
                        return
                    columns = [column[:rows] for column in self._columns]
                    keys = list(self._keys)
                self._check()
                self._part_data = self._write_part(self._part, appended(self._part_data, _table(keys, *columns)))
                self._part_rows += rows
                with self._lock:
                    for column in self._columns:
                        del column[:rows]
                if self._part_rows == PART_ROWS:
                    self._open_part(self._part + 1, 0)

    def resume(self, step: int) -> None:
        """Drops all rows beyond `step`, the step of the checkpoint that training goes on from; -1: all rows.

        A damaged part is set aside beside metrics/ with a warning: its rows are lost, the others stay.
        """
        with self._io:
            self._check()
            last = rows = 0
            for path in sorted((self.dir / "metrics").glob("part-*.parquet")):
                number = int(path.stem[5:])
                table = self._part_table(path)
                kept = table.filter(pc.less_equal(table["step"], step))
                # Emptied, not removed: a reader that has just listed the folder must find every file.
                if kept.num_rows < table.num_rows:
                    self._write_part(number, rewritten(self._part_bytes(number), partial(encode, kept)))
                if kept.num_rows:
                    last, rows = (number, kept.num_rows) if kept.num_rows < PART_ROWS else (number + 1, 0)
            self._open_part(last, rows)
            self._step = max(step, 0)
            self._ready = True
            self._write_status()

    def _part_table(self, path: Path) -> pa.Table:
        try:
            return read_part(path)
        except StoreError as error:
            aside = self.dir / f"damaged-{time.time_ns()}-{path.name}"
            with reporting(path):
                keep_copy(path, aside)
            self._write_part(int(path.stem[5:]), EMPTY_PART)
            self.warn(f"{error}; set aside as {aside.name}, its rows are missing from now on")
            return schemas.METRICS.empty_table()

    def _open_part(self, number: int, rows: int) -> None:
        """Further rows join part `number`, which has `rows` of them."""
        self._part, self._part_rows, self._part_data = number, rows, self._part_bytes(number)

    def _part_bytes(self, number: int) -> bytes:
        path = self._part_path(number)
        return _bytes(path) if path.exists() else EMPTY_PART

    def _part_path(self, number: int) -> Path:
        return self.dir / "metrics" / f"part-{number:05d}.parquet"

    def _write_part(self, number: int, data: bytes) -> bytes:
        # The temporary file stays out of metrics/: a reader must never list a file that is gone when it is opened.
        replace(self._part_path(number), data, scratch=self.dir)
        return data

    def _index(self, key: str) -> int:
        return self._keys.setdefault(key, len(self._keys))

    # Tables, pictures and texts

    def write_eval(self, rows: Iterable[Mapping[str, Any]]) -> None:
        """eval.parquet: one row an evaluated image, with at least `image`; the step is the last one logged.

        Columns psnr, ssim, lpips, lpips_reason, depth_error are always there; further ones are float64 or text.
        """
        with self._io:
            data = rewritten(self._eval_data, partial(encode, schemas.evaluation(rows, self._step)))
            self._write("eval.parquet", data)
            self._eval_data = data

    def write_summary(self, results: Mapping[str, Any]) -> None:
        """Adds to the one row of summary.parquet; what was there under other names stays."""
        with self._io:
            self._results |= plain(results, "summary")
            row = schemas.summary(self._results | {"run_id": self.run_id}, self.config)
            data = rewritten(self._summary_data, partial(encode_row, row))
            self._write("summary.parquet", data)
            self._summary_data = data

    def write_environment(self, environment: Mapping[str, Any], diff: str = "") -> None:
        """environment.json and, where the code differs from its commit, dirty.diff.

        A resumed run keeps the first ones; if something differs by then, environment-2.json and so on join them.
        """
        data = (json.dumps(plain(environment, "environment"), indent=1) + "\n").encode()
        for number in range(1, 10_000):
            suffix = "" if number == 1 else f"-{number}"
            path, patch = self.dir / f"environment{suffix}.json", self.dir / f"dirty{suffix}.diff"
            if path.exists():
                known = read_bytes(patch, MOST_DIFF_BYTES) if patch.exists() else b""
                same = read_bytes(path, MOST_DIFF_BYTES) == data and known == diff.encode()
                if same:
                    return
                continue
            if diff:
                self._write(patch.name, diff.encode())
            self._write(path.name, data)
            return

    def save_image(self, name: str, image: np.ndarray) -> None:
        """images/<name>.png from (H, W), (H, W, 3) or (H, W, 4) uint8."""
        from PIL import Image

        if not name or Path(name).name != name or name.startswith("."):
            raise ValueError(f"save_image: expected a plain file name, got {name!r}")
        if image.dtype != np.uint8 or not (image.ndim == 2 or (image.ndim == 3 and image.shape[2] in (3, 4))):
            raise ValueError(f"save_image: expected (H, W[, 3 or 4]) uint8, got {image.shape} {image.dtype}")
        file = name if name.endswith(".png") else f"{name}.png"
        data = io.BytesIO()
        Image.fromarray(image).save(data, format="PNG")
        with self._io:
            self._check()
            with reporting(self.dir / "images"):
                (self.dir / "images").mkdir(exist_ok=True)
            replace(self.dir / "images" / file, data.getvalue(), scratch=self.dir, durable=False)

    def text_log(self, line: str) -> None:
        """Appends to log.txt, with the local time before it."""
        path = self.dir / "log.txt"
        text = f"{time.strftime('%Y-%m-%d %H:%M:%S')} {' '.join(line.splitlines())}\n"
        with self._io, reporting(path), open_plain(path, "ab") as file:
            file.write(text.encode())

    def warn(self, line: str) -> None:
        """To log.txt and to the program's log (standard error unless set otherwise)."""
        _log.warning(line)
        with contextlib.suppress(StoreError):
            self.text_log(f"warning: {line}")

    # Checkpoints

    def save_checkpoint(self, content: Mapping[str, Any]) -> None:
        """Rows up to now, then checkpoint.pt; the one before stays as checkpoint.prev.pt.

        Content: tensors and plain values, as torch.load(weights_only=True) accepts them; ValueError otherwise.
        """
        with self._io:
            self.flush()
            self._check()
            self._checkpoints.save(dict(content))

    def load_checkpoint(self) -> dict[str, Any] | None:
        """The last checkpoint that can be read, with its tensors on the CPU; None when there is none.

        A damaged one is set aside with a warning.
        """
        with self._io:
            return self._checkpoints.load()

    # State

    def status(self, *, state: str = "running", step: int | None = None, error: str | None = None) -> None:
        """Writes status.json now; the thread repeats it with every heartbeat."""
        if self._error is not None:
            raise self._error
        with self._io:
            self._check()
            self._step = self._step if step is None else int(step)
            self._status |= {"state": state, "error": error}
            self._write_status()

    def finish(self, summary: Mapping[str, Any] | None = None) -> None:
        """The run is complete: the same command again skips it."""
        self._end("finished", None, summary)
        with contextlib.suppress(OSError):
            (self.dir / "checkpoint.prev.pt").unlink()

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
        with contextlib.suppress(StoreError):  # the first error tells more
            if isinstance(error, Exception):
                self.fail(f"{str(error) or type(error).__name__}")
            else:
                self.interrupt()

    def _end(self, state: str, error: str | None, summary: Mapping[str, Any] | None = None) -> None:
        """Rows, summary, then the state, which counts. As much as can be written is, and ownership goes in any case."""
        if self._closed:
            return
        self._stop()
        problem = self._error
        try:
            try:
                if self._ready:
                    self.flush()
                self.write_summary({**(summary or {}), "state": state, "error": error})
            except StoreError as failure:
                problem = problem or failure
            if problem is not None:
                state, error = "failed", error or str(problem)
            self._status |= {"state": state, "error": error}
            self._check()
            self._write_status(durable=True)
            if problem is not None:
                raise problem
        finally:
            self._closed = True
            with contextlib.suppress(StoreError):
                self._ownership.release()

    def _keep(self, every: float) -> None:
        while True:
            self._wake.wait(every)
            self._wake.clear()
            if self._stopping:
                return
            try:
                with self._io:
                    self._check()
                    self.flush()
                    self._write_status()
            except Exception as error:  # told by the next log()
                known = isinstance(error, StoreError)
                self._error = error if known else StoreError(f"{self.dir}: cannot write: {error}")  # type: ignore
                return

    def _stop(self) -> None:
        self._stopping = True
        self._wake.set()
        self._keeper.join(timeout=60)
        atexit.unregister(self._stop)

    def _check(self) -> None:
        self._ownership.check()

    def _write(self, name: str, data: bytes) -> None:
        with self._io:
            self._check()
            replace(self.dir / name, data)

    def _write_status(self, durable: bool = False) -> None:
        with self._io:
            status = {"run_id": self.run_id, **self._status, "step": self._step, "heartbeat": time.time()}
            self._status = status
            replace(self.dir / "status.json", (json.dumps(status, indent=1) + "\n").encode(), durable=durable)


def _bytes(path: Path) -> bytes:
    with reporting(path, "read"):
        return read_bytes(path, MOST_TABLE_BYTES)


def _table(keys: Sequence[str], steps: array, times: array, indices: array, values: array) -> pa.Table:
    """Rows of metrics from columns of equal length; `keys[indices]` are the names."""
    names = pa.DictionaryArray.from_arrays(pa.array(np.asarray(indices)), pa.array(keys, pa.string()))
    return pa.table(
        [pa.array(np.asarray(steps)), pa.array(np.asarray(times)), names, pa.array(np.asarray(values))],
        schemas.METRICS.names,
    )


def _number(key: str, value: Any) -> float:
    try:
        if not isinstance(value, str):
            return float(value)
    except (TypeError, ValueError, RuntimeError):
        pass
    raise ValueError(f"log: {key} expects a number, got {value!r}")
