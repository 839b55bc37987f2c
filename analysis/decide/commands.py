"""Candidates that are programs of the user's own: each seed is one process, whose tracked run is the result.

The process finds its seed in `QNERF_SEED`, or as `{seed}` in the command, and the store in `QNERF_STORE`.
`qnerf.track` writes the folder of its run into the file `QNERF_TRACKED`, by which the run is found again; who owns that
file's folder trains the run, as with runs.
"""

import hashlib
import math
import os
import shlex
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from qnerf.cli.sweep import RETRY
from qnerf.records import owner, state

from .records import FOLDER

TRACKED, SECONDS = "tracked", "seconds"


def run_of(words: Sequence[str], seed: int, store: Path) -> Path:
    """The folder of a run; before a process has tracked one, a file that does not exist."""
    file = _folder(words, seed, store) / TRACKED
    return store / Path(file.read_text()).name if file.exists() else file


def train(words: Sequence[str], seeds: Sequence[int], store: Path, foresee: Callable[[float], object]) -> None:
    """Trains the runs that are not finished, with the errors of `_process`; `foresee` gets the `seconds` of each."""
    while left := [seed for seed in seeds if state(run_of(words, seed, store)) != "finished"]:
        ended = next((seed for seed in left if _process(words, seed, store)), None)
        if ended is None:
            time.sleep(RETRY)
        else:
            foresee(seconds(words, ended, store))


def seconds(words: Sequence[str], seed: int, store: Path) -> float:
    """What the processes of a run took, their start included, which its own `train_s` lacks; NaN where none ended."""
    file = _folder(words, seed, store) / SECONDS
    return float(file.read_text()) if file.exists() else math.nan


def _process(words: Sequence[str], seed: int, store: Path) -> bool:
    """Trains one run; False where another process does.

    ValueError where none is left that is finished, KeyboardInterrupt where it was stopped.
    """
    what, folder = f"{shlex.join(words)}, seed {seed}", _folder(words, seed, store)
    folder.mkdir(parents=True, exist_ok=True)
    if not isinstance(mine := owner.acquire(folder), owner.Ownership):
        return False
    try:
        if (now := state(run_of(words, seed, store))) in ("finished", "running"):
            return now == "finished"
        print(what, flush=True)
        begun = time.monotonic()
        own = {"QNERF_SEED": str(seed), "QNERF_STORE": str(store.absolute()), "QNERF_TRACKED": str(folder / TRACKED)}
        with child([word.replace("{seed}", str(seed)) for word in words], env=os.environ | own) as process:
            code = process.wait()
        before = seconds(words, seed, store) if (folder / SECONDS).exists() else 0.0
        (folder / SECONDS).write_text(str(before + time.monotonic() - begun))
    except FileNotFoundError as error:
        raise ValueError(f"{what}: {error.strerror}; expected a command, or overrides such as field=qcolor") from error
    finally:
        mine.release()
    run = run_of(words, seed, store)
    if (now := state(run)) == "finished":
        return True
    if code:
        raise ended(code, what)
    if run.name == TRACKED or not run.is_dir():
        raise ValueError(f"{what}: left no run in {store}; expected `with qnerf.track(...)`, without store=")
    raise ValueError(f"{what}: left its run {now}; expected `run.finish(...)` with the metric")


def _folder(words: Sequence[str], seed: int, store: Path) -> Path:
    name = hashlib.sha256(f"{shlex.join(words)} {seed}".encode()).hexdigest()[:20]
    return store.absolute() / FOLDER / "commands" / name


@contextmanager
def child(command: Sequence[str], **options: Any) -> Iterator[subprocess.Popen[str]]:
    """A process that does not outlive what is done with it."""
    with subprocess.Popen(command, **options) as process:
        try:
            yield process
        except BaseException:
            process.terminate()
            process.wait()
            raise


def ended(code: int, what: str) -> BaseException:
    """What a process with this exit code raises here."""
    return KeyboardInterrupt() if code in (130, -2) else ValueError(f"{what}: ended with exit code {code}")
