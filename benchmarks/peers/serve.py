"""A model that trains in a process of its own and takes orders, one JSON object a line.

The process that gives the orders can train each model in its own environment. `Remote` is its side.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol

ROOT = Path(__file__).parents[2]


class Trained(Protocol):
    """A model that can train and render."""

    def take_step(self) -> None: ...

    def render(self, path: str) -> None:
        """Writes the held-out views to an npz file: colour (V, H W, 3) in [0, 1], depth and accumulation (V, H W)."""


def serve(build: Callable[[], Trained]) -> None:
    """Builds the model and follows the orders on standard input until it ends.

    Answers go to the standard output that the process began with. Everything else that is printed goes to standard
    error.
    """
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    model = build()

    def answer(**values: object) -> None:
        print(json.dumps(values), file=answers, flush=True)

    answer(ready=True)
    for line in sys.stdin:
        order = json.loads(line)
        start, cpu = time.perf_counter(), time.process_time()
        if order["do"] == "steps":
            for _ in range(order["count"]):
                model.take_step()
        elif order["do"] == "render":
            model.render(order["path"])
        answer(seconds=time.perf_counter() - start, cpu=time.process_time() - cpu)


class Remote:
    """A served model.

    Args:
        command: starts its process, which calls `serve`.
        threads: of PyTorch and of compiled loops.

    Raises:
        RuntimeError: the process ended; the message is the last line that it printed.
    """

    def __init__(self, command: Sequence[str], threads: int) -> None:
        environment = dict(os.environ, OMP_WAIT_POLICY="PASSIVE", OMP_NUM_THREADS=str(threads))
        # So that the process finds this checkout's qnerf in an environment that has only what qnerf needs.
        environment["PYTHONPATH"] = os.pathsep.join(filter(None, [str(ROOT / "src"), environment.get("PYTHONPATH")]))
        self.errors = tempfile.TemporaryFile("w+")  # noqa: SIM115 (`close` closes it)
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self.errors, text=True, cwd=ROOT,
            env=environment,
        )  # fmt: skip
        self._answer()

    def _answer(self) -> dict[str, Any]:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            lines = [text for text in self.close().splitlines() if text.strip()]
            raise RuntimeError(lines[-1] if lines else f"exit code {self.process.returncode}")
        answer: dict[str, Any] = json.loads(line)
        return answer

    def order(self, do: str, **values: object) -> dict[str, Any]:
        assert self.process.stdin is not None
        print(json.dumps({"do": do, **values}), file=self.process.stdin, flush=True)
        return self._answer()

    def close(self) -> str:
        """Ends the process and returns what it printed."""
        if self.errors.closed:
            return ""
        self.process.communicate()
        with self.errors:
            self.errors.seek(0)
            return self.errors.read()

    def __enter__(self) -> "Remote":
        return self

    def __exit__(self, *error: object) -> None:
        self.close()
