"""Which compiled loop serves which module, dtype and device: one table, and what stepped aside and why.

A loop may stand for modules that it does not call, such as a hash grid with its MLP. It was written for exact classes
and for the options that these had then. So the table names both, and a loop steps aside for anything else: a derived
class, an option that came later, a module with hooks. The plain PyTorch reference runs instead.
"""

import contextlib
import inspect
from collections.abc import Iterator, Mapping, Sequence, Set
from functools import cache
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd import forward_ad

FLOATS = (torch.float32, torch.float64)

_GRID = "levels min_resolution max_resolution log2_table_size features dense"

_SPACE = {
    "qnerf.geometry.contraction.CubeContraction": frozenset[str](),
    "qnerf.geometry.contraction.Box": frozenset(["half_extent"]),
    "qnerf.geometry.visibility.SpaceMask": frozenset[str](),
}
_NETWORK = {
    "qnerf.encoders.hash.HashEncoder": frozenset(_GRID.split()),
    "qnerf.rendering.proposal_sampler.ProposalNetwork": frozenset[str](),
}
_MLP = frozenset(["layers", "width", "init"])

_SHADINGS = {
    "qnerf.rendering.shading.EverySample": frozenset[str](),
    "qnerf.rendering.shading.MergeShading": frozenset(["parts"]),
}

LOOPS: dict[str, Mapping[str, frozenset[str]]] = {
    "proposals": _SPACE | _NETWORK,
    "sample places": _SPACE,
    "hash grid": {},
    "hash grid + MLP": _NETWORK | {"qnerf.heads.mlp.MLPHead": _MLP},
    "MLP": {"qnerf.heads.mlp.MLPHead": _MLP},
    "drawing edges": {},
    "volume weights": {},
    "shading": _SHADINGS,
    "interlevel loss": {},
    "distortion loss": {},
    "circuits": {},
}
"""Every compiled loop, in the order of a step, with the classes that it stands for and the options that it knows."""

_HOOKS = ("_forward_hooks", "_forward_pre_hooks", "_backward_hooks", "_backward_pre_hooks")
_GLOBAL_HOOKS = [getattr(nn.modules.module, f"_global{hooks}") for hooks in _HOOKS]

_plain = False
_reports: list[dict[str, str]] = []


def serves(
    loop: str,
    *tensors: Tensor,
    modules: Sequence[nn.Module] = (),
    called: Sequence[nn.Module | None] = (),
    but: str | None = None,
) -> bool:
    """Whether a compiled loop computes this call; if not, every open `report` learns why.

    Args:
        loop: its name in `LOOPS`.
        tensors: its inputs, of one dtype.
        modules: what it stands for, without calling them.
        called: their children that are called, whatever they are.
        but: another reason against it, which the caller knows.
    """
    reason = but or _against(LOOPS[loop], tensors, modules, called)
    if reason is None:
        return True
    step_aside(loop, reason)
    return False


def step_aside(loop: str, reason: str) -> None:
    """Tells every open `report` why a loop, or another fast way, does not compute; the first reason counts."""
    for report in _reports:
        report.setdefault(loop, reason)


def _against(
    known: Mapping[str, frozenset[str]],
    tensors: Sequence[Tensor],
    modules: Sequence[nn.Module],
    called: Sequence[nn.Module | None],
) -> str | None:
    """Why the loop does not compute this call; None: it does."""
    if _plain:
        return "inside plain()"
    dtype = tensors[0].dtype
    for tensor in tensors:
        if not tensor.is_cpu:
            return f"device {tensor.device.type}"
        if tensor.dtype != dtype or dtype not in FLOATS:
            return f"{tensor.dtype}".removeprefix("torch.")
    if is_transformed(*tensors):
        return "torch.func or forward-mode derivatives"
    if modules and any(_GLOBAL_HOOKS):
        return "hooks on all modules"
    apart = {id(module) for module in (*modules, *called)} if called else set()
    for module in modules:
        if reason := _unknown(type(module), known) or _watched(module, apart):
            return reason
    return None


def _unknown(kind: type, known: Mapping[str, frozenset[str]]) -> str | None:
    """Why a class is not one that the loop was written for; None: it is."""
    options = known.get(_path(kind))
    if options is None:
        base = next((base.__name__ for base in kind.__mro__ if _path(base) in known), None)
        return f"{kind.__name__} extends {base}" if base else f"{kind.__name__} has no loop"
    later = _options(kind) - options
    return f"option {min(later)} of {kind.__name__}" if later else None


@cache
def _path(kind: type) -> str:
    return f"{kind.__module__}.{kind.__qualname__}"


@cache
def _options(kind: Any) -> frozenset[str]:
    """The keyword-only parameters of a class, which are its options."""
    parameters = inspect.signature(kind).parameters.values()
    return frozenset(parameter.name for parameter in parameters if parameter.kind is parameter.KEYWORD_ONLY)


def _watched(module: nn.Module, apart: Set[int]) -> str | None:
    """Which of a module and its children, but for those `apart`, has a hook or a `forward` of its own, in words."""
    own = vars(module)
    if "forward" in own:
        return f"another forward of {type(module).__name__}"
    if own["_forward_hooks"] or own["_forward_pre_hooks"] or own["_backward_hooks"] or own["_backward_pre_hooks"]:
        return f"hooks on {type(module).__name__}"
    for child in own["_modules"].values():
        if child is not None and id(child) not in apart and (reason := _watched(child, apart)):
            return reason
    return None


def is_transformed(*tensors: Tensor) -> bool:
    """Whether `torch.func` is at work in this thread, or a tensor has a tangent of forward-mode differentiation.

    Both follow only PyTorch's own operations. `torch.no_grad` stops neither of them; `detach` does.
    """
    if torch._C._are_functorch_transforms_active():
        return True
    return forward_ad._current_level >= 0 and any(forward_ad.unpack_dual(t).tangent is not None for t in tensors)


@contextlib.contextmanager
def report(aside: dict[str, str] | None = None) -> Iterator[dict[str, str]]:
    """Collects the loops that step aside inside, each with the first reason. `described` puts them into words.

    aside: an earlier report, to be continued; None: a new one.
    """
    aside = {} if aside is None else aside
    _reports.append(aside)
    try:
        yield aside
    finally:
        _reports[:] = [other for other in _reports if other is not aside]


def described(aside: Mapping[str, str]) -> str:
    """What a run's record says about its loops.

    >>> described({})
    'all compiled'
    >>> described({"hash grid": "device cuda", "hash grid + MLP": "hooks on Linear", "circuits": "device cuda"})
    'hash grid, circuits: device cuda; hash grid + MLP: hooks on Linear'
    """
    loops: dict[str, list[str]] = {}
    for loop, reason in aside.items():
        loops.setdefault(reason, []).append(loop)
    return "; ".join(f"{', '.join(names)}: {reason}" for reason, names in loops.items()) or "all compiled"


@contextlib.contextmanager
def plain() -> Iterator[None]:
    """Inside, every compiled loop is replaced by its plain PyTorch reference. Tests and benchmarks compare with it."""
    global _plain
    before, _plain = _plain, True
    try:
        yield
    finally:
        _plain = before


def is_plain() -> bool:
    """Whether `plain` is in force."""
    return _plain
