"""Processes for the fault tests, forked from one that has imported everything, so that a round takes milliseconds.

python -m tests.helpers.jobs kills STORE RUNS SEED   short trainings, each killed at four random moments, then finished
python -m tests.helpers.jobs claims STORE ROUNDS     several processes claim one run at the same moment; rounds per kind
Prints one JSON line per round.
"""

import json
import os
import random
import signal
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path

from qnerf.records import Run, RunStore

STEPS = 120
CONTENDERS = 3
KILLS = 4


def train(run: Run, pace: float = 0.0005) -> None:
    """A random walk: every number depends on all before it."""
    import torch

    random_state = torch.Generator().manual_seed(0)
    value = torch.zeros(50, dtype=torch.float64)
    first = 0
    content = run.load_checkpoint() if run.resumed else None
    if content is not None:
        value, first = content["value"], content["step"] + 1
        random_state.set_state(content["random"])
    run.resume(first - 1)
    for step in range(first, STEPS):
        value = 0.9 * value + torch.randn(50, dtype=torch.float64, generator=random_state)
        run.log(step, time.monotonic(), {f"value{i}": value[i].item() for i in range(10)})
        if step % 7 == 6:
            run.save_checkpoint({"step": step, "value": value, "random": random_state.get_state()})
        if step % 40 == 39:
            run.write_eval([{"image": f"{i}", "psnr": value[i].item()} for i in range(5)])
        time.sleep(pace)
    run.save_checkpoint({"step": STEPS - 1, "value": value, "random": random_state.get_state()})
    run.finish({"psnr": value.sum().item(), "steps": STEPS})


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


def kills(root: Path, runs: int, seed: int) -> None:
    import torch

    torch.set_num_threads(1)
    store = RunStore(root, every=0.003)
    rng = random.Random(seed)

    def job(name: str) -> None:
        claim = store.claim(name, {"seed": 0})
        if claim.outcome == "finished":  # it was killed after its last write
            return
        assert claim.run is not None, claim.message
        train(claim.run)

    begin = time.monotonic()
    assert os.waitpid(fork(lambda: job("whole")), 0)[1] == 0
    whole = time.monotonic() - begin  # seconds, with the present load of the machine
    for number in range(runs):
        name, killed = f"run-{number}", 0
        for _ in range(KILLS):
            pid = fork(lambda name=name: job(name))
            time.sleep(rng.uniform(0.0, 0.6 * whole))
            os.kill(pid, signal.SIGKILL)
            killed += os.WIFSIGNALED(os.waitpid(pid, 0)[1])
        assert os.waitpid(fork(lambda name=name: job(name)), 0)[1] == 0
        print(json.dumps({"run": name, "killed": killed}), flush=True)


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
    mode, store_root, count = sys.argv[1:4]
    if mode == "kills":
        kills(Path(store_root), int(count), int(sys.argv[4]))
    else:
        for kind in ("new", "stale", "force"):
            claims(Path(store_root), int(count), kind)
