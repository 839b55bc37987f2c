"""The hard cases of `benchmarks.accuracy`: one module a group of parts, each with a function `cases() -> list[Case]`.

Every module in this folder is read; there is no list of them. A module's docstring is printed above its tables: a
title, then the limits that the reader must know. A case is one differentiable function of a few tensors in several
forms (`variants`), measured in float32 and in float64 against `exact` in float64. Its inputs are float64 numbers that
float32 holds exactly, so that no variant is blamed for the rounding of its inputs.

    def cases() -> list[Case]:
        variants = fast_and_plain(volume_weights, volume_weights_reference)
        return [Case("rendering", "opaque first sample", variants, (density, delta), bound=16 * EPS, wanted=(0,))]

The bounds are constants of these modules, with their derivation; the tests in `tests/numerics` search for worse inputs
against the same constants.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from pkgutil import iter_modules
from types import ModuleType

import torch
from torch import Tensor

from qnerf.kernels import plain

EPS = torch.finfo(torch.float32).eps
"""Distance of 1 to the next float32, 2^-23: bounds are multiples of it."""
BOTH_ROUND = 1e-13
"""The smallest bound in float64, where the reference has rounding errors of its own."""
ACCEPTED_GRADIENT = 1e-4
"""The accepted error of any gradient in float32, relative to the largest one."""

Function = Callable[..., Tensor]


@dataclass(frozen=True)
class Case:
    """One function on one kind of input.

    Args:
        part: what of the pipeline it is, as the table groups it: "rendering".
        name: the hard input: "opaque first sample".
        variants: name -> function of the inputs, in their dtype, to one tensor.
        inputs: float64 tensors of which float32 holds every value; integer and boolean ones are passed on as they are.
        bound: of the forward error in float32, relative to the largest output, for the variants that are `bounded`.
        gradient: the same bound for the error of the gradients, each relative to its largest; None for no gradient.
        wanted: numbers of the inputs that have a gradient; default: the floating ones.
        exact: the float64 reference; default: the variant "plain".
        dtypes: those in which the variants are offered.
    """

    part: str
    name: str
    variants: Mapping[str, Function]
    inputs: tuple[Tensor, ...]
    bound: float
    gradient: float | None = ACCEPTED_GRADIENT
    wanted: tuple[int, ...] | None = None
    exact: Function | None = None
    dtypes: tuple[torch.dtype, ...] = field(default=(torch.float32, torch.float64))

    @property
    def id(self) -> str:
        return f"{self.part}: {self.name}"

    @property
    def bounded(self) -> list[str]:
        """The variants that must keep the bounds: all but "plain", if there are others."""
        return [name for name in self.variants if name != "plain"] or ["plain"]

    @property
    def reference(self) -> Function:
        return self.exact or self.variants["plain"]

    @property
    def leaves(self) -> tuple[int, ...]:
        """Numbers of the inputs that have a gradient."""
        if self.gradient is None:
            return ()
        if self.wanted is not None:
            return self.wanted
        return tuple(i for i, tensor in enumerate(self.inputs) if tensor.is_floating_point())


def bound_in(dtype: torch.dtype, bound: float) -> float:
    """A bound for float32 in another dtype: in float64 2^-29 times that, but at least `BOTH_ROUND`."""
    return bound if dtype == torch.float32 else max(bound * torch.finfo(dtype).eps / EPS, BOTH_ROUND)


def only(function: Function) -> dict[str, Function]:
    """The variants of a function that has one form."""
    return {"plain": function}


def plainly(function: Function) -> Function:
    """The function with every compiled loop inside it replaced by its plain PyTorch reference."""

    def slow(*inputs: Tensor) -> Tensor:
        with plain():
            return function(*inputs)

    return slow


def fast_and_plain(function: Function, reference: Function | None = None) -> dict[str, Function]:
    """Variants "fast" and "plain" of a function that has a compiled loop, or a reference of its own."""
    return {"fast": function, "plain": reference or plainly(function)}


def rounded(values: object) -> Tensor:
    """The nearest numbers that float32 holds, in float64: what both dtypes can start from."""
    return torch.as_tensor(values, dtype=torch.float32).double()


def modules() -> dict[str, ModuleType]:
    """The modules in this folder, by name."""
    return {module.name: import_module(f"{__name__}.{module.name}") for module in iter_modules(__path__)}


def every() -> list[Case]:
    """The cases of all modules."""
    return [case for module in modules().values() for case in module.cases()]
