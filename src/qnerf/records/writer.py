"""The writer of one run. Everything that it writes is readable at any moment and survives kill -9.

Rows of metrics collect in memory. A thread writes them every few seconds, together with the heartbeat. Each time it
replaces the open part by a longer one, so there is nothing to compact or to repair. If the thread fails, the next call
of `log` raises its error.
"""

import atexit
import contextlib
import io
import logging
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from qnerf.config.identity import is_unicode, plain
from qnerf.records import schemas
from qnerf.records.checkpoints import Checkpoints
from qnerf.records.environment import differences
from qnerf.records.files import StoreError, json_bytes, read_json, replace, reporting
from qnerf.records.owner import HEARTBEAT_INTERVAL, Ownership, Process
from qnerf.records.parquet import encode
from qnerf.records.read import metric_parts, part_name, read_config, read_part, read_status, read_summary, summary_copy

PART_ROWS = 65_536
EMPTY_PART = encode(schemas.METRICS_SCHEMA.empty_table())

_log = logging.getLogger("qnerf")


def running_status(ownership: Ownership) -> dict[str, Any]:
    """What status.json says about the owner while it writes the run."""
    return asdict(Process.current()) | {"state": "running", "claim": ownership.nonce, "error": None}


class Run:
    """Writes into a run's folder; `RunStore.claim` makes it.

    As a context manager it ends the run in any case: after Ctrl-C, or without a call of `finish`, as interrupted; after
    another error as failed. If `resumed` is true there was something before, and `resume` must be called before `log`.
    """

    def __init__(
        self,
        ownership: Ownership,
        *,
        resumed: bool,
        every: float = HEARTBEAT_INTERVAL,
        types: Mapping[str, str] | None = None,
    ) -> None:
        self.dir = ownership.directory
        self.run_id = self.dir.name
        self.resumed = resumed
        self._types = dict(types or {})
        self._ownership = ownership
        self._checkpoints = Checkpoints(self.dir, ownership.check, self.warn)
        with _advising_deletion():
            self.config = read_config(self.dir)
            self._results = schemas.results(read_summary(self.dir), self.config)
        self._status: dict[str, Any] = {"step": 0, "created": time.time()} | read_status(self.dir)
        self._status |= running_status(ownership)
        self._step: int = self._status["step"]
        self._accepts_rows = not resumed
        self._closed = self._stopping = False

        self._lock = threading.Lock()  # for the rows; held for microseconds
        self._io = threading.RLock()  # for the files
        self._rows: list[tuple[int, float, str, float]] = []  # that are not on disk yet
        self._part, self._part_table = 0, schemas.METRICS_SCHEMA.empty_table()

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

    def log(self, step: int, time_s: float, values: Mapping[str, float], *, done: int | None = None) -> None:
        """One row per value. step: training step, from 0, or where the values stand on another axis; done: the training
        step then. time_s: seconds of training so far.

        Raises:
            ValueError: the step is no whole number, a key no text or a value no number; no row is logged then.
            StoreError: an earlier row could not be written, or this is a fork of the process that writes the run.
        """
        assert self._accepts_rows, "a resumed run logs only after resume(step)"
        assert not self._closed, "the run has ended"
        self._ownership.refuse_fork()
        if self._error is not None:
            raise self._error
        place = _whole(step)
        rows = [(place, float(time_s), _key(key), _number(key, value)) for key, value in values.items()]
        with self._lock:
            self._rows += rows
            self._step = place if done is None else done
            full = len(self._rows) >= PART_ROWS
        if full:
            self._wake.set()

    def flush(self) -> None:
        """Returns when all rows so far are on disk."""
        with self._io:
            while self._rows:
                rows = self._rows[: PART_ROWS - self._part_table.num_rows]
                self._ownership.check()
                new = pa.table(list(map(list, zip(*rows, strict=True))), schema=schemas.METRICS_SCHEMA)
                table = pa.concat_tables([self._part_table, new]).combine_chunks()
                self._write_part(self._part, encode(table))
                self._part_table = table
                with self._lock:
                    del self._rows[: len(rows)]
                if table.num_rows == PART_ROWS:
                    self._part, self._part_table = self._part + 1, table.slice(0, 0)

    def resume(self, step: int, seconds: float | None = None) -> None:
        """Drops all rows after `step`, the step of the checkpoint from which training goes on; -1 drops all rows.

        seconds: of training at that checkpoint, which decide instead where rows have other axes.

        Raises:
            StoreError: a part is damaged.
        """
        with self._io:
            self._ownership.check()
            for number, path in metric_parts(self.dir).items():
                with _advising_deletion():
                    table = read_part(path)
                column, last = ("step", step) if seconds is None else ("time_s", seconds)
                remaining = table.filter(pc.less_equal(table[column], last))
                # The part is emptied, not removed: a reader may just have listed the folder and must find every file.
                if remaining.num_rows < table.num_rows:
                    self._write_part(number, encode(remaining))
                if remaining.num_rows:
                    full = remaining.num_rows >= PART_ROWS
                    self._part = number + 1 if full else number
                    self._part_table = remaining.slice(0, 0) if full else remaining
            self._step = max(step, 0)
            self._accepts_rows = True
            self._write_status()

    def _write_part(self, number: int, data: bytes) -> None:
        # No temporary file in metrics/: a reader must not list a file that is gone when it opens it.
        self._write(f"metrics/{part_name(number)}", data)

    # Tables, pictures and texts

    def write_eval(self, rows: Iterable[Mapping[str, Any]]) -> None:
        """eval.parquet: one row per evaluated image, with at least `image`; the step is the last one logged.

        Columns psnr, ssim, lpips, lpips_reason, depth_error always exist; others are float64, or text for `*_reason`.
        """
        self._write("eval.parquet", encode(schemas.evaluation(rows, self._step)))

    def write_summary(self, results: Mapping[str, Any]) -> None:
        """Adds results to the one row of summary.parquet; results with other names stay."""
        with self._io:
            self._results |= plain(results, "summary")
            row = schemas.summary(self._results | {"run_id": self.run_id}, self.config, self._types)
            data = encode(row)
            self._write("summary.parquet", data)
            self._status["summary"] = summary_copy(row, data)

    def write_environment(self, environment: Mapping[str, Any], diff: str = "") -> None:
        """environment.json and, if the code differs from its commit, dirty.diff.

        A resumed run keeps the first ones. What is different now is a line of log.txt.
        """
        try:
            before = read_json(self.dir / "environment.json")
        except (OSError, StoreError):  # absent or damaged
            if diff:
                self._write("dirty.diff", diff.encode())
            self._write("environment.json", json_bytes(plain(environment, "environment")))
        else:
            if changed := differences(before, environment):
                now = ", ".join(f"{name}={value}" for name, (_, value) in changed.items())
                self.text_log(f"goes on in another environment: {now}")

    def write_transform(self, similarity: np.ndarray) -> None:
        """dataparser_transforms.json, as nerfstudio writes it: how the source's world became the normalised one.

        `transform` is a rigid motion (3, 4), which comes first, and `scale` the factor after it.
        similarity: (4, 4).
        """
        scale = float(np.cbrt(np.linalg.det(similarity[:3, :3])))
        content = {"transform": (similarity[:3] / scale).tolist(), "scale": scale}
        self._write("dataparser_transforms.json", json_bytes(content))

    def save_image(self, name: str, image: np.ndarray) -> None:
        """images/<name>.png from (H, W), (H, W, 3) or (H, W, 4) uint8."""
        if not name or Path(name).name != name or name.startswith("."):
            raise ValueError(f"picture: expected a plain file name, got {name!r}")
        data = _png(image)
        with reporting(self.dir / "images"):
            (self.dir / "images").mkdir(exist_ok=True)
        self._write(f"images/{name if name.endswith('.png') else f'{name}.png'}", data, durable=False)

    def save_preview(self, image: np.ndarray) -> None:
        """preview.png, the state of a view while the run trains."""
        self._write("preview.png", _png(image), durable=False)

    def text_log(self, line: str) -> None:
        """Appends the local time and the line to log.txt."""
        path = self.dir / "log.txt"
        text = f"{time.strftime('%Y-%m-%d %H:%M:%S')} {' '.join(line.splitlines())}\n"
        self._ownership.refuse_fork()
        with self._io, reporting(path), open(path, "ab") as file:
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
        self._ownership.refuse_fork()
        with self._io:
            self.flush()
            self._ownership.check()
            self._checkpoints.save(dict(content))

    def load_checkpoint(self, check: Callable[[dict[str, Any]], None] = lambda content: None) -> dict[str, Any] | None:
        """The last checkpoint that can be read, with its tensors on the CPU; see `Checkpoints.load`."""
        with self._io:
            return self._checkpoints.load(check)

    def go_on(self, check: Callable[[dict[str, Any]], None], by: str = "step") -> dict[str, Any] | None:
        """The last checkpoint, as `load_checkpoint`; rows of metrics after it go, by its `step` or by its `seconds`."""
        content = self.load_checkpoint(check)
        if content is None:
            self.resume(-1)
        else:
            self.resume(content["step"], content["seconds"] if by == "seconds" else None)
        return content

    # State

    def finish(self, summary: Mapping[str, Any] | None = None) -> None:
        """The run is complete. The same command again will skip it."""
        self._end("finished", None, summary)
        with contextlib.suppress(OSError):
            (self.dir / "checkpoint.prev.pt").unlink()

    def fail(self, error: str) -> None:
        self._end("failed", " ".join(error.encode(errors="replace").decode().split()))

    def interrupt(self, step: int | None = None) -> None:
        """step: of the last checkpoint, if it is later than the last row."""
        self._step = max(self._step, step or 0)
        self._end("interrupted", None)

    def __enter__(self) -> "Run":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._closed or self._ownership.inherited:
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

        If one of them cannot be written, the others still are, and ownership is released in any case.
        """
        if self._closed:
            return
        self._ownership.refuse_fork()
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

    def _write(self, name: str, data: bytes, *, durable: bool = True) -> None:
        """Replaces a file. Temporary files lie in the run's folder, so that nobody lists them in metrics/ or images/.

        The owner is checked last: a process may be stopped, or wait for a disk, for longer than its claim lasts.
        """
        self._ownership.refuse_fork()
        with self._io:
            self._ownership.check()
            path = self.dir / name
            replace(path, data, temporary_folder=self.dir, durable=durable, before_rename=self._ownership.check)

    def _write_status(self, durable: bool = False) -> None:
        with self._io:
            self._status |= {"run_id": self.run_id, "step": self._step, "heartbeat": time.time()}
            self._write("status.json", json_bytes(self._status), durable=durable)


@contextlib.contextmanager
def _advising_deletion() -> Iterator[None]:
    """Adds to the message about a damaged file how to go on."""
    try:
        yield
    except StoreError as error:
        raise StoreError(f"{error}; delete this file, and the run goes on without it") from error


def _png(image: np.ndarray) -> bytes:
    from PIL import Image

    if image.dtype != np.uint8 or not (image.ndim == 2 or (image.ndim == 3 and image.shape[2] in (3, 4))):
        raise ValueError(f"picture: expected (H, W[, 3 or 4]) uint8, got {image.shape} {image.dtype}")
    data = io.BytesIO()
    Image.fromarray(image).save(data, format="PNG")
    return data.getvalue()


def _whole(step: Any) -> int:
    with contextlib.suppress(TypeError, ValueError, OverflowError):
        if int(step) == step and abs(int(step)) < 2**63:
            return int(step)
    raise ValueError(f"log: expected a whole number as the step, got {step!r:.100}")


def _key(key: Any) -> str:
    if not isinstance(key, str) or not key or not is_unicode(key):
        raise ValueError(f"log: expected text as a key, got {key!r:.100}")
    return str(key)


def _number(key: str, value: Any) -> float:
    try:
        if not isinstance(value, (str, bytes)):
            return float(value.detach() if hasattr(value, "detach") else value)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        pass
    raise ValueError(f"log: {key} expects a number, got {value!r}")
