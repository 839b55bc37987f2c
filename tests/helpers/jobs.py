"""Processes for the fault tests, forked from one that has imported everything, so that a round takes milliseconds.

python -m tests.helpers.jobs STORE ROUNDS: several processes claim one run at the same moment; rounds per kind.
Prints one JSON line per round.
"""

import json
import os
import signal
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path

from qnerf.records import RunStore

CONTENDERS = 3


def fork(job: Callable[[], None]) -> int:
    """Runs `job` in a child process and returns its pid. Exit code: 0, the one of SystemExit, or 1 with a traceback."""
    sys.stdout.flush()
    pid = os.fork()
    if pid == 0:
        code = 1
        try:
            job()
            code = 0
        except SystemExit as stop:
            code = stop.code if isinstance(stop.code, int) else int(stop.code is not None)
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stderr.flush()
            os._exit(code)
    return pid


def claims(root: Path, rounds: int, kind: str) -> None:
    """kind: new: there is no such run; stale: its owner was killed; force: it is finished and is started again."""
    store = RunStore(root)

    def earlier(name: str) -> None:
        claim = store.claim(name, {"seed": 0})
        assert claim.run is not None
        if kind == "force":
            claim.run.finish()
        else:
            os.kill(os.getpid(), signal.SIGKILL)

    for number in range(rounds):
        name = f"{kind}-{number}"
        if kind != "new":
            os.waitpid(fork(lambda name=name: earlier(name)), 0)
        results, answers = os.pipe()
        gate, opener = os.pipe()
        start = time.monotonic() + 0.02

        def contend(name: str = name, answers: int = answers, gate: int = gate, start: float = start) -> None:
            os.close(opener)  # noqa: B023
            while time.monotonic() < start:
                pass
            claim = store.claim(name, {"seed": 0}, force=kind == "force")
            os.write(answers, f"{claim.outcome} ".encode())
            os.read(gate, 1)  # the winner stays alive until all have answered
            if claim.run is not None:
                claim.run.flush()
                claim.run.finish()

        pids = [fork(contend) for _ in range(CONTENDERS)]
        outcomes: list[str] = []
        while len(outcomes) < CONTENDERS:
            data = os.read(results, 4096)
            outcomes += data.decode().split()
        os.close(opener)
        codes = [os.waitpid(pid, 0)[1] for pid in pids]
        for handle in (results, answers, gate):
            os.close(handle)
        print(json.dumps({"kind": kind, "outcomes": sorted(outcomes), "codes": codes}), flush=True)


if __name__ == "__main__":
    for kind in ("new", "stale", "force"):
        claims(Path(sys.argv[1]), int(sys.argv[2]), kind)
