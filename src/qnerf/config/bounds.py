"""What an option's annotation promises about its value: types, types of elements, bounds.

`Annotated[int, Interval(ge=1, le=64)]` declares bounds, `Literal["mean", "sum"]` choices, `list[int]` elements. Numbers
are finite and integers have at most 64 bits without a declaration. Hypothesis builds values from the same annotations.
"""

import functools
import inspect
import math
import types
from collections.abc import Callable
from typing import Annotated, Any, Literal, ParamSpec, TypeVar, Union, get_args, get_origin, get_type_hints

from annotated_types import Ge, GroupedMetadata, Gt, Interval, Le, Lt, MaxLen, MinLen

Share = Annotated[float, Interval(ge=0, le=1)]
PositiveInt = Annotated[int, Interval(ge=1, le=10**9)]
NonNegativeInt = Annotated[int, Interval(ge=0, le=10**9)]
Seed = Annotated[int, Interval(ge=0, le=2**63 - 1)]
Count = Annotated[int, Interval(ge=1, le=2**16)]  # units, features, samples: each takes memory
Depth = Annotated[int, Interval(ge=1, le=256)]  # layers
Factor = Annotated[float, Interval(ge=-(10**6), le=10**6)]
PositiveFactor = Annotated[float, Interval(gt=0, le=10**6)]
NonNegativeFactor = Annotated[float, Interval(ge=0, le=10**6)]

P = ParamSpec("P")
T = TypeVar("T")


def check(name: str, value: Any, hint: Any) -> None:
    """ValueError that names the option, the value and what was expected, unless the value fits the annotation.

    >>> check("samples", [8, 0], list[PositiveInt])
    Traceback (most recent call last):
        ...
    ValueError: samples[1] must be between 1 and 1000000000, got 0
    >>> check("scale", float("nan"), float)
    Traceback (most recent call last):
        ...
    ValueError: scale must be finite, got nan
    """
    if not _has_type(value, hint):
        raise ValueError(f"{name} expects {_type_name(hint)}, got {value!r} ({type(value).__name__})")
    base, limits = _unpacked(hint)
    origin, parts = get_origin(base), get_args(base)
    if origin in (Union, types.UnionType):
        check(name, value, next(part for part in parts if _has_type(value, part)))
    elif origin in (list, tuple) and parts:
        if origin is tuple and parts[-1] is not Ellipsis:
            if len(value) != len(parts):
                raise ValueError(f"{name} expects {len(parts)} values, got {len(value)}")
            elements = parts
        else:
            elements = (parts[0],) * len(value)
        for number, (item, part) in enumerate(zip(value, elements, strict=True)):
            check(f"{name}[{number}]", item, part)
    elif origin is dict and parts:
        for key, item in value.items():
            check(f"{name}.{key}", item, parts[1])
    for limit in limits:
        if isinstance(limit, (MinLen, MaxLen)):
            _check_length(name, len(value), limit)
    if type(value) in (int, float) and not _is_inside(value, limits):
        raise ValueError(f"{name} must be {_limits_text(value, limits)}, got {_short(value)}")


def checked(function: Callable[P, T]) -> Callable[P, T]:
    """The function, which checks its arguments against their annotations first: for what users call directly.

    >>> @checked
    ... def circle(*, radius: PositiveFactor = 1.0): ...
    >>> circle(radius=0)
    Traceback (most recent call last):
        ...
    ValueError: radius must be above 0 and at most 1000000, got 0
    """
    signature = inspect.signature(function)

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> T:
        hints = get_type_hints(function, include_extras=True)
        for name, value in signature.bind(*args, **kwargs).arguments.items():
            check(name, value, hints.get(name, Any))
        return function(*args, **kwargs)

    return call


def _unpacked(hint: Any) -> tuple[Any, list[Any]]:
    """The bare annotation, and its limits one by one."""
    if get_origin(hint) is not Annotated:
        return hint, []
    base, *metadata = get_args(hint)
    limits: list[Any] = []
    for item in metadata:
        limits += list(item) if isinstance(item, GroupedMetadata) else [item]
    return base, limits


def _has_type(value: Any, hint: Any) -> bool:
    """Whether the value has the annotated type, apart from its elements and bounds. YAML's lists are tuples, too, and a
    bool is not a number."""
    hint, _ = _unpacked(hint)
    origin = get_origin(hint)
    if origin in (Union, types.UnionType):
        return any(_has_type(value, part) for part in get_args(hint))
    if origin is Literal:
        return any(type(value) is type(choice) and value == choice for choice in get_args(hint))
    if hint in (int, float):
        return isinstance(value, (int, hint)) and not isinstance(value, bool)
    if origin in (list, tuple):
        return isinstance(value, (list, tuple))
    expected = origin or hint
    return expected is Any or not inspect.isclass(expected) or isinstance(value, expected)


def _type_name(hint: Any) -> str:
    hint, _ = _unpacked(hint)
    origin, parts = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        return " or ".join("null" if part is types.NoneType else _type_name(part) for part in parts)
    if origin is Literal:
        return f"one of {', '.join(map(str, parts))}"
    if origin in (list, tuple) and parts:
        return f"a list of {_type_name(parts[0])}"
    return getattr(hint, "__name__", str(hint))


def _is_inside(value: float, limits: list[Any]) -> bool:
    if isinstance(value, int):
        if not -(2**63) <= value < 2**63:
            return False
    elif not math.isfinite(value):
        return False
    tests: dict[type, Callable[[float, Any], bool]] = {
        Gt: lambda value, limit: value > limit.gt,
        Ge: lambda value, limit: value >= limit.ge,
        Lt: lambda value, limit: value < limit.lt,
        Le: lambda value, limit: value <= limit.le,
    }
    return all(tests[type(limit)](value, limit) for limit in limits if type(limit) in tests)


def _limits_text(value: float, limits: list[Any]) -> str:
    """Such as "between 1 and 64" or "finite and above 0"."""
    low = high = ""
    for limit in limits:
        if isinstance(limit, (Gt, Ge)):
            low = f"above {limit.gt}" if isinstance(limit, Gt) else f"at least {limit.ge}"
        elif isinstance(limit, (Lt, Le)):
            high = f"below {limit.lt}" if isinstance(limit, Lt) else f"at most {limit.le}"
    if low.startswith("at least ") and high.startswith("at most "):
        return f"between {low[9:]} and {high[8:]}"
    if isinstance(value, int) and not low + high:
        return "within 64 bits"
    return " and ".join(text for text in ("" if high else "finite", low, high) if text)


def _check_length(name: str, length: int, limit: MinLen | MaxLen) -> None:
    if isinstance(limit, MinLen) and length < limit.min_length == 1:
        raise ValueError(f"{name} must not be empty")
    if isinstance(limit, MinLen) and length < limit.min_length:
        raise ValueError(f"{name} must have at least {limit.min_length} values, got {length}")
    if isinstance(limit, MaxLen) and length > limit.max_length:
        raise ValueError(f"{name} must have at most {limit.max_length} values, got {length}")


def _short(value: float) -> str:
    """The number; integers of hundreds of digits by their size."""
    return (
        repr(value) if isinstance(value, float) or abs(value) < 10**30 else f"an integer of {value.bit_length()} bits"
    )
