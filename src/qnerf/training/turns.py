"""Several trainings in one process, a step of each in turn: on a GPU their steps are computed side by side."""

import contextlib
import traceback
from collections.abc import Callable, Generator, Sequence
from typing import Generic, TypeVar

import torch

from qnerf.kernels import dispatch

T = TypeVar("T")
Training = Callable[[dict[str, str]], Generator[bool, None, T]]


class Turns(Generic[T]):
    """Trainings that take turns. Each finds what belongs to the process as it has left it: PyTorch's threads and its
    random numbers on the CPU, and the report of loops that step aside. On CUDA each of several has a stream of its own.

    Args:
        trainings: called with their report, they return what takes a step at every `next`, and returns its result. It
            yields whether the others need not wait on the device for what the step has sent there. They have to where
            that may be the first use of something that is kept for all of them, such as the constants of a circuit.
        device: of all of them.
    """

    def __init__(self, trainings: Sequence[Training[T]], device: torch.device) -> None:
        streams = device.type == "cuda" and len(trainings) > 1
        self._going = [_Turn(training, torch.cuda.Stream(device) if streams else None) for training in trainings]
        self._all = list(self._going)

    def round(self) -> bool:
        """A step of each training that goes on; whether one still does."""
        for turn in list(self._going):
            if not turn.take():
                for other in self._all:
                    other.wait_for(turn)
            if turn.result:
                self._going.remove(turn)
        return bool(self._going)

    def results(self) -> list[T | Exception]:
        """What each training has returned, or the exception that it has ended with."""
        return [result for turn in self._all for result in turn.result]

    def close(self) -> None:
        """Ends the trainings that go on as an interruption does."""
        with contextlib.ExitStack() as stack:
            for turn in self._going:
                stack.callback(turn.training.close)


class _Turn(Generic[T]):
    def __init__(self, training: Training[T], stream: torch.cuda.Stream | None) -> None:
        self.aside: dict[str, str] = {}
        self.training = training(self.aside)
        self.stream = stream
        self.random, self.threads = torch.get_rng_state(), torch.get_num_threads()
        self.result: list[T | Exception] = []  # one, at the end

    def take(self) -> bool:
        torch.set_rng_state(self.random)
        if self.threads != torch.get_num_threads():
            torch.set_num_threads(self.threads)
        apart = False
        with torch.cuda.stream(self.stream), dispatch.report(self.aside):
            try:
                apart = next(self.training)
            except StopIteration as end:
                self.result = [end.value]
            except Exception as error:
                traceback.clear_frames(error.__traceback__)  # they hold the model
                self.result = [error]
        self.random, self.threads = torch.get_rng_state(), torch.get_num_threads()
        return apart

    def wait_for(self, other: "_Turn[T]") -> None:
        if self.stream and other.stream and other is not self:
            self.stream.wait_stream(other.stream)
