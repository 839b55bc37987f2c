"""Real trainings for the fault tests, forked from one process that has imported and compiled everything.

python -m tests.helpers.trainings kills JOB KILLS SEED    trainings, each killed at a random moment and then finished
python -m tests.helpers.trainings twins JOB ROUNDS        the same command twice in the same instant
Prints one JSON line per round. JOB is a JSON file with `overrides` as a user types them, the `config` that they give,
and `store`, the folder for the stores.
"""

import contextlib
import functools
import io
import json
import multiprocessing
import os
import random
import signal
import sys
import time
from pathlib import Path

from qnerf import experiment
from qnerf.cli import main
from qnerf.records import RunStore

SEEDS = 2  # different trainings


def forked(job, *arguments):
    process = multiprocessing.get_context("fork").Process(target=job, args=arguments)
    process.start()
    return process


def ended(process):
    """The exit code, or minus the signal that ended the process."""
    process.join()
    return process.exitcode


def train(config):
    outcome = experiment.run(config)
    assert outcome.state == "finished", outcome.message


def kills(config, root, wanted, seed):
    """Rows, heartbeats and checkpoints are written fifty times a second, so that kills hit them."""
    experiment.RunStore = functools.partial(RunStore, every=0.02)
    rng = random.Random(seed)
    for number in range(SEEDS):
        whole = config | {"seed": number, "store": str(root / "whole")}
        begin = time.monotonic()
        assert ended(forked(train, whole)) == 0
        latest = time.monotonic() - begin  # seconds, with the present load of the machine
    number = landed = 0
    while landed < wanted:
        mine = config | {"seed": number % SEEDS, "store": str(root / f"killed-{number:03d}")}
        process = forked(train, mine)
        after = rng.uniform(0, latest)
        time.sleep(after)
        process.kill()
        killed = ended(process) == -signal.SIGKILL  # else it had finished: the load is smaller by now
        latest *= 1.03 if killed else 0.8
        code = ended(forked(train, mine))
        print(json.dumps({"number": number, "after": after, "killed": killed, "code": code}), flush=True)
        landed += killed
        number += 1


def twins(overrides, root, rounds):
    os.environ["COLUMNS"] = "1000"  # lines stay whole

    def command(seed, start):
        output = io.StringIO()
        sys.argv = ["qnerf", "run", *overrides, f"store={root / 'twins'}", f"seed={seed}"]
        try:
            while time.monotonic() < start:
                pass
            with contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
                main.main()
        finally:
            (root / f"output-{os.getpid()}").write_text(output.getvalue())

    for seed in range(rounds):
        start = time.monotonic() + 0.05
        processes = [forked(command, seed, start) for _ in range(2)]
        codes = [ended(process) for process in processes]
        texts = [(root / f"output-{process.pid}").read_text().splitlines() for process in processes]
        outputs = [[line for line in text if line.startswith(("run ", str(root)))] for text in texts]
        print(json.dumps({"seed": seed, "codes": codes, "outputs": outputs}), flush=True)


if __name__ == "__main__":
    mode, file, count, *rest = sys.argv[1:]
    job = json.loads(Path(file).read_text())
    store = Path(job["store"])
    train(job["config"] | {"store": str(store / "warm-up")})
    if mode == "kills":
        kills(job["config"], store, int(count), int(rest[0]))
    else:
        twins(job["overrides"], store, int(count))
