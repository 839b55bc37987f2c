"""Compiled CPU loops: the decorator `jit`, and `run`, which shares a loop among threads.

A kernel is a function `kernel(start, stop, *arrays)` that writes the outputs of items start..stop and no others. The
result therefore does not depend on the number of threads. Kernels release the GIL and run on plain Python threads. A
second OpenMP pool would compete with PyTorch's.
"""

import contextlib
import gc
import os
import sys
from collections.abc import Callable, Iterator
from itertools import count, pairwise
from queue import SimpleQueue
from threading import Lock, Thread, local
from typing import Any, TypeAlias

import numba
import numpy as np
import torch
from numba.core import event, types

Kernel: TypeAlias = Callable[..., Any]


class _Loops(local):
    threads: int | None = None  # of compiled loops that this thread starts, where PyTorch has fewer


_loops = _Loops()
_kernels: set[Any] = set()


def jit(function: Kernel, **options: Any) -> Kernel:
    """Compiles on first use for the types at hand and caches the machine code on disk. `options` are those of Numba.

    The cache is beside the source file, or in the user's cache folder. If neither can be written there is none.

    Raises:
        ValueError: NUMBA_DISABLE_JIT is set. Most loops use vectors, which Python does not have.
    """
    if numba.config.DISABLE_JIT:  # type: ignore[attr-defined]
        raise ValueError("NUMBA_DISABLE_JIT: expected to be unset, because the loops of qnerf only exist compiled")
    options |= {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}  # only C code would call that
    try:
        kernel: Any = numba.njit(function, cache=True, **options)
    except RuntimeError:  # "no locator available": no folder for the cache can be written
        kernel = numba.njit(function, cache=False, **options)
    _kernels.add(kernel)
    template = kernel.get_call_template  # a private part of Numba, for which pyproject.toml has an upper bound

    def without_numbers(arguments: Any, named: dict[str, Any]) -> Any:
        """What calls with these types run: Numba would compile a function once more for every number in a call."""
        return template(
            tuple(map(types.unliteral, arguments)), {name: types.unliteral(kind) for name, kind in named.items()}
        )

    kernel.get_call_template = without_numbers
    return kernel


class _Announcer(event.Listener):
    """Says once, on stderr, that kernels are being compiled. Numba sends the event on a cache miss only.

    Meanwhile no garbage is collected. The compiler makes millions of objects, and to look through them all again and
    again takes a tenth of its time.
    """

    def __init__(self) -> None:
        self.announced = False
        self.depth = 0  # Numba compiles in one thread at a time, a kernel with what it calls
        self.collects = False

    def on_start(self, event: Any) -> None:
        if self.depth == 0:
            self.collects = gc.isenabled()
            gc.disable()
        self.depth += 1
        if not self.announced and event.data["dispatcher"] in _kernels and "pytest" not in sys.modules:
            self.announced = True
            print("compiling kernels, once for this environment", file=sys.stderr, flush=True)

    def on_end(self, event: Any) -> None:
        self.depth -= 1
        if self.depth == 0 and self.collects:
            gc.enable()


event.register("numba:compile", _Announcer())


class _Job:
    """One loop over `parts`. Any thread that is free takes the next one."""

    def __init__(self, kernel: Kernel, arguments: tuple[Any, ...], parts: list[tuple[int, int]]) -> None:
        self.kernel, self.arguments = kernel, arguments
        self.remaining = iter(parts)  # next() on a list iterator and on a count is atomic
        self.last, self.ended = len(parts), count(1)
        self.failure: BaseException | None = None
        self.running = Lock()
        self.running.acquire()

    def work(self) -> None:
        for start, stop in self.remaining:
            try:
                self.kernel(start, stop, *self.arguments)
            except BaseException as failure:
                self.failure = failure
            if next(self.ended) == self.last:
                self.running.release()


class _Workers:
    """Threads that wait for jobs in a queue written in C. Futures of the standard pool cost more than small kernels."""

    def __init__(self) -> None:
        self.jobs: SimpleQueue[_Job] = SimpleQueue()
        self.started = 0
        self.starting = Lock()

    def call(self, job: _Job, threads: int) -> None:
        if self.started < threads:
            with self.starting:
                while self.started < threads:
                    Thread(target=self.serve, name=f"qnerf-kernel-{self.started}", daemon=True).start()
                    self.started += 1
        for _ in range(threads):
            self.jobs.put(job)

    def serve(self) -> None:
        while True:
            self.jobs.get().work()


_workers = _Workers()

if hasattr(os, "register_at_fork"):  # a forked child has none of its parent's threads
    os.register_at_fork(after_in_child=lambda: _workers.__init__())  # type: ignore[misc]


def loop_threads() -> int:
    """How many threads share a compiled loop: as many as PyTorch has, also inside `one_torch_thread`."""
    return _loops.threads or torch.get_num_threads()


@contextlib.contextmanager
def one_torch_thread(active: bool = True) -> Iterator[None]:
    """Inside, PyTorch's own operations run on one thread, if `active`; compiled loops keep theirs.

    A step of training is hundreds of small operations. To wake a second thread for one of them takes longer than it
    saves.
    """
    outer, pytorch = _loops.threads, torch.get_num_threads()
    if not active or pytorch == 1:
        yield
        return
    _loops.threads = loop_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(pytorch)
        _loops.threads = outer


def split(items: int, parts: int) -> list[tuple[int, int]]:
    """Contiguous ranges of nearly equal length that cover range(items), without empty ones.

    >>> split(7, 3)
    [(0, 2), (2, 4), (4, 7)]
    """
    edges = [items * i // parts for i in range(parts + 1)]
    return [(a, b) for a, b in pairwise(edges) if b > a]


def flat(tensor: torch.Tensor) -> np.ndarray:
    """The tensor's numbers, row by row. NumPy reshapes faster than PyTorch."""
    if not tensor.is_contiguous():
        tensor = tensor.contiguous()  # a loop is compiled for contiguous arrays only
    array: np.ndarray = (tensor.detach() if tensor.requires_grad else tensor).numpy().reshape(-1)
    return array


def _flattened(arguments: tuple[Any, ...]) -> tuple[Any, ...]:
    """Arguments of `run` as a loop takes them. Named tuples are for compiled code and hold arrays already."""
    return tuple(
        [
            flat(one) if isinstance(one, torch.Tensor) else _flattened(one) if type(one) is tuple else one
            for one in arguments
        ]
    )


def run(kernel: Kernel, items: int, *arguments: Any, grain: int | None = None) -> None:
    """Calls `kernel(start, stop, *arguments)` over range(items), on as many threads as PyTorch uses.

    Tensors, also those in tuples, become flat arrays: of the same memory if they are contiguous, else of a copy.

    A thread takes about `grain` items at a time or more; by default each takes an equal share. Pass it where items cost
    different amounts, or where few items are not worth waking a thread for. There are at most two parts for a thread:
    between parts the threads wait for each other, because Python runs one at a time.

    The calling thread works too and waits only for parts that another thread has begun. It never needs a free thread,
    so kernels may run from any thread, even from inside another kernel's part.
    """
    arguments = _flattened(arguments)
    count = loop_threads()
    pieces = 1 if count == 1 else min(items, count if grain is None else min(items // grain, 2 * count))
    if pieces <= 1:
        if items > 0:
            kernel(0, items, *arguments)
        return
    parts = split(items, pieces)
    job = _Job(kernel, arguments, parts)
    _workers.call(job, min(count, len(parts)) - 1)
    job.work()
    with job.running:
        pass
    if job.failure is not None:
        raise job.failure
