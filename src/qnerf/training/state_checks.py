"""Checks of what a checkpoint holds, all of them before anything is loaded.

A checkpoint may be damaged or come from anybody. Kernels trust their tensors: with a moment of the wrong shape, fused
Adam would read and write outside it.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

MOMENTS = ("exp_avg", "exp_avg_sq")
CPU_STATE = len(torch.Generator().get_state())  # bytes of a random generator's state
CUDA_STATE = 16


def largest_state(model: torch.nn.Module, steps: int) -> int:
    """Bytes that a checkpoint of the model takes at most.

    That is the model, the two moments of Adam and the times of all steps, with 16 MiB for everything else.
    """
    tensors = sum(value.nbytes for value in model.state_dict().values())
    return (1 + len(MOMENTS)) * tensors + 8 * steps + 2**24


def check_tensor(name: str, value: Any, like: Tensor, *, finite: bool = True) -> None:
    """ValueError unless `value` is an ordinary CPU tensor with the shape and dtype of `like`.

    finite: refuse NaN and infinities.
    """
    check_plain(name, value)
    if value.shape != like.shape or value.dtype != like.dtype:
        expected, got = (f"{_dtype(one)} of shape {list(one.shape)}" for one in (like, value))
        raise ValueError(f"{name}: expected {expected}, got {got}")
    if not value.is_contiguous() and value.stride() != like.stride():
        raise ValueError(f"{name}: expected a contiguous tensor")
    if value.dtype == torch.bool and value.numel() and int(value.contiguous().view(torch.uint8).max()) > 1:
        raise ValueError(f"{name}: holds bytes that are neither true nor false")
    if finite and not bool(torch.isfinite(value).all()):
        raise ValueError(f"{name}: not finite")


def check_plain(name: str, value: Any) -> None:
    """ValueError unless `value` is a tensor with its numbers in CPU memory, one after the other."""
    if type(value) is not Tensor:
        raise ValueError(f"{name}: expected a tensor, got {type(value).__name__}")
    plain = value.layout == torch.strided and not value.is_nested and not value.is_quantized
    if not plain or value.device.type != "cpu":
        raise ValueError(f"{name}: expected an ordinary tensor, got one that is sparse, nested, quantised or empty")


def check_keys(name: str, value: Any, keys: Sequence[Any]) -> None:
    """ValueError unless `value` is a dict with exactly these keys."""
    if not isinstance(value, dict):
        raise ValueError(f"{name}: expected a dict, got {type(value).__name__}")
    for kind, different in (("lacks", set(keys) - value.keys()), ("has the unknown key", value.keys() - set(keys))):
        if different:
            shown = sorted(str(key) if type(key) in (str, int) else type(key).__name__ for key in different)
            raise ValueError(f"{name}: {kind} {', '.join(shown)[:100]}")


def check_integer(name: str, value: Any, lowest: int, highest: int) -> None:
    if type(value) is not int or not lowest <= value <= highest:
        shown = value if type(value) in (int, float) else type(value).__name__
        raise ValueError(f"{name}: expected an integer from {lowest} to {highest}, got {shown}")


def check_model(state: Any, own: Mapping[str, Tensor], *, finite: bool) -> None:
    """ValueError unless `state` fits the model whose `state_dict()` is `own`."""
    check_keys("model", state, list(own))
    for name, like in own.items():
        check_tensor(f"model.{name}", state[name], like, finite=finite)


def check_adam(state: Any, optimiser: torch.optim.Optimizer, step: int, *, finite: bool) -> set[Tensor]:
    """The parameters without moments: those that never had a gradient.

    Raises:
        ValueError: `state` is not one of this Adam after `step` steps.
    """
    without: set[Tensor] = set()
    if not isinstance(state, dict) or not isinstance(state.get("state"), dict):
        raise ValueError("optimiser: expected a dict with the state of each parameter")
    own = optimiser.state_dict()["param_groups"]
    groups = state.get("param_groups")
    if not isinstance(groups, list) or [_numbers(group) for group in groups] != [_numbers(group) for group in own]:
        raise ValueError("optimiser: the groups of parameters are not those of this run")
    moments = state["state"]
    known = set()
    for group, mine in zip(optimiser.param_groups, own, strict=True):
        known |= set(mine["params"])
        for number, parameter in zip(mine["params"], group["params"], strict=True):
            name = f"optimiser.{group['name']}.{number}"
            if number not in moments:
                without.add(parameter)
                continue
            check_keys(name, moments[number], ["step", *MOMENTS])
            for moment in MOMENTS:
                check_tensor(f"{name}.{moment}", moments[number][moment], parameter, finite=finite)
            check_tensor(f"{name}.step", moments[number]["step"], torch.zeros((), dtype=torch.float32))
            count = float(moments[number]["step"])
            if not 1 <= count <= step or not count.is_integer():
                raise ValueError(f"{name}.step: expected an integer from 1 to {step}, got {count}")
            if bool((moments[number]["exp_avg_sq"] < 0).any()):
                raise ValueError(f"{name}.exp_avg_sq: below 0")
    if not moments.keys() <= known:
        raise ValueError("optimiser: moments of parameters that this run does not have")
    return without


def _numbers(group: Any) -> list[int] | None:
    """The numbers of a group's parameters, if they are plain integers."""
    numbers = group.get("params") if isinstance(group, dict) else None
    return numbers if isinstance(numbers, list) and all(type(number) is int for number in numbers) else None


def first_non_finite(model: torch.nn.Module, optimiser: torch.optim.Optimizer) -> str | None:
    """The name of a parameter, buffer or moment with a value that is not finite; None: there is none."""
    tensors = {f"model.{name}": value for name, value in model.state_dict().items()}
    for group in optimiser.param_groups:
        for parameter in group["params"]:
            for moment in MOMENTS:
                if moment in optimiser.state.get(parameter, {}):
                    tensors[f"optimiser.{group['name']}.{moment}"] = optimiser.state[parameter][moment]
    return next((name for name, value in tensors.items() if not bool(torch.isfinite(value).all())), None)


def check_stream(name: str, value: Any, device: torch.device) -> None:
    """ValueError unless `value` is the state of a random generator, of `device` or of another kind of device."""
    check_plain(name, value)
    sizes = (CPU_STATE,) if name != "streams.samples" else (CPU_STATE, CUDA_STATE)
    if value.dtype != torch.uint8 or value.dim() != 1 or len(value) not in sizes:
        raise ValueError(f"{name}: expected {' or '.join(map(str, sizes))} bytes, got {_dtype(value)} {value.shape}")
    generator = torch.Generator(device)
    if len(value) == len(generator.get_state()):
        try:
            generator.set_state(value)
        except RuntimeError:
            raise ValueError(f"{name}: not the state of a random generator") from None


def check_plateau(state: Any) -> None:
    check_keys("plateau", state, ["best", "since"])
    best = state["best"]
    if type(best) is not float or math.isnan(best) or best == math.inf:
        raise ValueError("plateau.best: expected a PSNR in dB")
    check_integer("plateau.since", state["since"], 0, 2**31)


def check_seconds(value: Any, step: int) -> None:
    check_plain("step_seconds", value)
    if value.dtype != torch.float64 or value.dim() != 1 or len(value) > step:
        raise ValueError(f"step_seconds: expected at most {step} float64 values, got {_dtype(value)} {value.shape}")
    if not bool(torch.isfinite(value).all()) or bool((value < 0).any()):
        raise ValueError("step_seconds: expected finite times from 0")


def _dtype(value: Tensor) -> str:
    return str(value.dtype).removeprefix("torch.")
