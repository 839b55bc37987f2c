"""Training steps as CUDA graphs: what a step sends to the device is recorded once, and sent as a whole from then on.

A graph holds the terms of the loss, with those that are only logged, their sum and its gradients. The batch is copied
into the graph's own tensors before each replay, and the optimiser's step stays outside. What the host decides while a
step is recorded is frozen. So nothing of it may change: `Loop.phase` says what of the step decides, and there is a
graph for each phase. Whatever else reads the number of the step is refused, and all steps then go the plain way.
"""

import contextlib
from collections import Counter
from collections.abc import Callable, Hashable, Iterator
from typing import Any, NamedTuple, NoReturn

import torch
from torch import Tensor, nn

from qnerf.kernels.dispatch import step_aside
from qnerf.training.optimiser import forget_gradients

NAME = "CUDA graph"  # in a run's record
WARM = 3  # plain steps of a phase before it is recorded: they load and choose what a recording must not
_READS = """bool int float complex index round trunc floor ceil hash str repr format eq ne lt le gt ge neg pos abs
invert add radd sub rsub mul rmul truediv rtruediv floordiv rfloordiv mod rmod divmod rdivmod pow rpow and rand or ror
xor rxor lshift rlshift rshift rrshift"""


class Unread:
    """Stands for the number of the step while a step is recorded. Whatever reads it is refused, and noted."""

    read = False

    def _refuse(self, *_: object) -> NoReturn:
        self.read = True
        raise RuntimeError("it reads the number of the step")


for _name in _READS.split():
    setattr(Unread, f"__{_name}__", Unread._refuse)


class Card:
    """What of a graph is CUDA's own: the stream of a training, and the memory that its graphs share."""

    def __init__(self, device: torch.device) -> None:
        self.stream = torch.cuda.Stream(device)
        self.pool = torch.cuda.graph_pool_handle()

    @contextlib.contextmanager
    def on_stream(self) -> Iterator[None]:
        """Work inside follows what was sent before, and precedes what is sent later."""
        outer = torch.cuda.current_stream(self.stream.device)
        self.stream.wait_stream(outer)
        try:
            with torch.cuda.stream(self.stream):
                yield
        finally:
            outer.wait_stream(self.stream)

    def record(self, call: Callable[[], None], generator: torch.Generator) -> Callable[[], None]:
        """The call's work as a graph: what replays it. To record computes nothing and draws no random numbers."""
        graph = torch.cuda.CUDAGraph()
        graph.register_generator_state(generator)
        generators = [generator, torch.cuda.default_generators[self.stream.device.index]]
        states = [own.get_state() for own in generators]
        try:
            with torch.cuda.graph(graph, self.pool, self.stream, capture_error_mode="thread_local"):
                call()
        except BaseException:
            for own, state in zip(generators, states, strict=True):  # CUDA's refusal leaves them inside the recording
                fresh = torch.Generator(own.device)
                fresh.set_state(state)
                own.graphsafe_set_state(fresh)
            raise
        return graph.replay


class Recorded(NamedTuple):
    """A graph, with the tensors that it reads and those that it writes."""

    batch: list[Tensor]
    terms: dict[str, Tensor]
    loss: Tensor
    gradients: list[tuple[nn.Parameter, Tensor]]
    replay: Callable[[], None]


class Graphs:
    """The graphs of a training.

    Args:
        device: of the training.
        wanted: whether steps are to be recorded; only CUDA can.
    """

    def __init__(self, device: torch.device, wanted: bool) -> None:
        self.card = Card(device) if wanted and device.type == "cuda" else None
        if wanted and self.card is None:
            step_aside(NAME, f"device {device.type}")
        self.seen: Counter[Hashable] = Counter()
        self.recorded: dict[Hashable, Recorded] = {}

    def stream(self) -> contextlib.AbstractContextManager[None]:
        return self.card.on_stream() if self.card else contextlib.nullcontext()

    def compute(self, loop: Any, drawn: list[Tensor]) -> tuple[Tensor, dict[str, Tensor]] | None:
        """The loss and its terms from a graph, with the gradients in place; None: go the plain way."""
        phase = loop.phase() if self.card else None
        if phase is None:
            return None
        if phase not in self.recorded:
            self.seen[phase] += 1
            if self.seen[phase] <= WARM or not self._record(phase, loop, drawn):
                return None
        graph = self.recorded[phase]
        for own, values in zip(graph.batch, drawn, strict=True):
            own.copy_(values)
        graph.replay()
        forget_gradients(loop.optimiser)
        for parameter, gradient in graph.gradients:
            parameter.grad = gradient
        return graph.loss, graph.terms

    def _record(self, phase: Hashable, loop: Any, drawn: list[Tensor]) -> bool:
        assert self.card
        batch = [values.clone() for values in drawn]
        terms: dict[str, Tensor] = {}
        losses: list[Tensor] = []

        def step() -> None:
            terms.update(loop.terms(batch))
            losses.append(loop.loss(terms))
            losses[0].backward()

        on_cpu = [torch.default_generator, loop.streams["pixels"]]
        random = [own.get_state() for own in on_cpu]
        forget_gradients(loop.optimiser)
        try:
            with loop.unread() as number:
                replay = self.card.record(step, loop.streams["samples"])
            if number.read:
                number._refuse()
            if not all(torch.equal(own.get_state(), state) for own, state in zip(on_cpu, random, strict=True)):
                loop.computing = "a step"
                raise RuntimeError("random numbers are drawn on the CPU")
        except Exception as error:  # the plain way raises it again if it is no matter of recording
            cause = error.__context__ or error  # CUDA names what it refused first, and then the end of the recording
            step_aside(NAME, f"{loop.computing}: {str(cause).splitlines()[0] if str(cause) else type(cause).__name__}")
            self.card = None
            self.recorded.clear()
            for own, state in zip(on_cpu, random, strict=True):
                own.set_state(state)
            return False
        parameters = [parameter for group in loop.optimiser.param_groups for parameter in group["params"]]
        gradients = [(parameter, parameter.grad) for parameter in parameters if parameter.grad is not None]
        outputs = {name: term.detach() for name, term in terms.items()}
        self.recorded[phase] = Recorded(batch, outputs, losses[0].detach(), gradients, replay)
        return True
