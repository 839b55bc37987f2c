"""Commands and helpers in processes of their own, because they are sent signals, are killed or compete for a run."""

import contextlib
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tests.helpers.configs import ROOT

PATIENCE = 300  # seconds, for a busy machine


def wait(ready, process=None):
    """Returns once `ready()` is true. That it takes too long, or that the process ends before, is a failure."""
    deadline = time.monotonic() + PATIENCE
    while not ready():
        assert process is None or process.poll() is None, "the process ended before its time"
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.02)


def start(module, *arguments, **options):
    """`python -m tests.helpers.<module> ARGUMENTS`, on one thread, with this checkout's package; `options` of Popen."""
    path = os.pathsep.join([str(ROOT), str(ROOT / "src"), *filter(None, [os.environ.get("PYTHONPATH")])])
    return subprocess.Popen(
        [sys.executable, "-m", f"tests.helpers.{module}", *arguments],
        text=True,
        env=os.environ | {"PYTHONPATH": path, "OMP_NUM_THREADS": "1"},
        **options,
    )


class Forked:
    """`qnerf ARGUMENTS`, forked from a process that has imported everything. It has the interface of `Popen`.

    A new interpreter would take seconds to import PyTorch. The process leads a session of its own.
    """

    def __init__(
        self, *arguments: str, cwd: Path = ROOT, env: dict[str, str] | None = None, before: Callable[[], Any] = bool
    ) -> None:
        """env: variables besides those of this process. before: is called in the process first; it is pickled."""
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload(["tests.helpers.warm"])
        ends = [context.Pipe(duplex=False) for _ in range(2)]
        (out, err), writers = ([end[side] for end in ends] for side in (0, 1))
        environment = dict(os.environ) | (env or {})
        self.process = context.Process(target=_command, args=(arguments, *writers, cwd, environment, before))
        self.process.start()
        for end in writers:
            end.close()
        self.stdout, self.stderr = _text(out), _text(err)
        self.pid = self.process.pid or 0

    @property
    def returncode(self):
        return self.process.exitcode

    def send_signal(self, number):
        os.kill(self.pid, number)

    def wait(self, timeout):
        self.process.join(timeout)
        if self.returncode is None:
            raise subprocess.TimeoutExpired("qnerf", timeout)
        return self.returncode

    def communicate(self, timeout):
        """What it writes until it ends."""
        texts = ["", ""]

        def read(number, stream):
            texts[number] = stream.read()

        readers = [threading.Thread(target=read, args=pair) for pair in enumerate((self.stdout, self.stderr))]
        for reader in readers:
            reader.start()
        self.wait(timeout)
        for reader in readers:
            reader.join()
        return texts[0], texts[1]

    def close(self):
        """Kills it and what it has started, if it has not ended."""
        if self.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self.pid, signal.SIGKILL)
        self.process.join()
        for stream in (self.stdout, self.stderr):
            stream.close()


def call(*arguments, **options):
    """What `qnerf ARGUMENTS` wrote and how it ended; `options` of `Forked`."""
    process = Forked(*arguments, **options)
    try:
        out, err = process.communicate(timeout=200)
        return subprocess.CompletedProcess(["qnerf", *arguments], process.wait(0), out, err)
    finally:
        process.close()


def _text(end):
    with end:
        return open(os.dup(end.fileno()))


def _command(arguments, out, err, cwd, env, before):
    os.setsid()
    for number, end in ((1, out), (2, err)):
        os.dup2(end.fileno(), number)
        end.close()
    sys.stdout = open(1, "w", closefd=False)  # noqa: SIM115
    sys.stderr = open(2, "w", buffering=1, errors="backslashreplace", closefd=False)  # noqa: SIM115
    os.environ.clear()
    os.environ.update(env)
    os.chdir(cwd)
    sys.path[:0] = filter(None, env.get("PYTHONPATH", "").split(os.pathsep))
    sys.argv = ["qnerf", *arguments]
    signal.signal(signal.SIGINT, signal.default_int_handler)  # which a server that began in the background ignores
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    before()

    from qnerf.cli.main import main

    main()
