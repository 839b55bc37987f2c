"""python -m tests.helpers.foreign_checkpoints FOLDER CONFIG short|full: a trainer reads checkpoints that were changed.

Each leaf of a checkpoint is changed in type, shape, dtype and value, or removed, or something is added. Bytes of the
file are flipped and cut off. Prints one JSON line per file: the change, the outcome and the warnings. Outcomes are
`previous` (the checkpoint before was loaded), `newest` (the changed one was loaded), `diverged` (the changed one was
loaded, and the next step is not finite) and `refused` (both files were changed). It runs in a process of its own,
because such a file may crash the interpreter.
"""

import copy
import io
import json
import random
import sys
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch

from qnerf.records import StoreError
from qnerf.records.checkpoints import Checkpoints
from qnerf.training.trainer import Diverged, Trainer
from tests.helpers.trainer import trainer

NEWEST, PREVIOUS = 3, 2  # steps
MISSING = object()

OBJECTS: dict[str, Any] = {
    "none": None, "text": "3", "negative": -5, "nan": float("nan"), "infinite": float("inf"), "large": 10**30,
    "true": True, "half": 1.5, "list": [1, 2], "dict": {}, "tensor": torch.zeros(3), "scalar": torch.tensor(2),
    "missing": MISSING,
}  # fmt: skip
TENSORS: dict[str, Callable[[torch.Tensor], Any]] = {
    "three zeros": lambda value: torch.zeros(3),
    "longer": lambda value: torch.cat([value.flatten(), value.flatten()[:1]]),
    "empty": lambda value: value.flatten()[:0],
    "one more dimension": lambda value: value[None],
    "float64": lambda value: value.to(torch.float32 if value.dtype == torch.float64 else torch.float64),
    "float16": lambda value: value.to(torch.float16),
    "int32": lambda value: value.to(torch.int32),
    "complex": lambda value: value.to(torch.complex64),
    "all nan": lambda value: _filled(value, float("nan")),
    "one infinite": lambda value: _one(value, float("inf")),
    "huge": lambda value: _filled(value, 1e38),
    "one value expanded": lambda value: value.flatten()[:1].clone().expand(value.numel()).view(value.shape),
    "sparse": lambda value: value.to_sparse(),
    "quantised": lambda value: torch.quantize_per_tensor(value.float(), 0.1, 0, torch.qint8),
    "nested": lambda value: torch.nested.nested_tensor([value.float().flatten(), torch.zeros(2)]),
    "meta": lambda value: value.to("meta"),
    "parameter": lambda value: torch.nn.Parameter(value.float()),
}


def _filled(value: torch.Tensor, number: float) -> torch.Tensor:
    return torch.full_like(value, number) if value.is_floating_point() else value.new_zeros(7)


def _one(value: torch.Tensor, number: float) -> torch.Tensor:
    changed = value.clone().float()
    changed.view(-1)[0] = number
    return changed


def leaves(node: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """The path of every value, containers included."""
    if path:
        yield path
    items = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    for key, value in items:
        yield from leaves(value, (*path, key))


def changed(state: dict[str, Any], path: tuple[Any, ...], value: Any) -> dict[str, Any]:
    copied = copy.deepcopy(state)
    node: Any = copied
    for key in path[:-1]:
        node = node[key]
    if value is MISSING:
        del node[path[-1]]
    else:
        node[path[-1]] = value
    return copied


def get(state: Any, path: tuple[Any, ...]) -> Any:
    for key in path:
        state = state[key]
    return state


def saved(content: Any) -> bytes:
    data = io.BytesIO()
    torch.save(content, data)
    return data.getvalue()


def files(state: dict[str, Any], full: bool) -> Iterator[tuple[str, bytes]]:
    """Name -> a changed checkpoint."""
    rng = random.Random(0)
    paths = list(leaves(state))
    if not full:  # all of the outer ones, a few of the parameters and their moments; a quarter of the changes of each
        inner = [path for path in paths if len(path) > 2 or path[0] == "model"]
        paths = [path for path in paths if path not in inner] + rng.sample(inner, 5)
    for path in paths:
        value = get(state, path)
        name = ".".join(map(str, path))
        others: dict[str, Any] = dict(OBJECTS)
        if isinstance(value, torch.Tensor):
            for label, change in TENSORS.items():
                try:
                    others[label] = change(value)
                except (RuntimeError, NotImplementedError):  # no such tensor of this dtype
                    continue
        if isinstance(value, dict):
            others["one more"] = value | {"more": 1}
        for label, other in others.items():
            if not full and rng.random() > 0.25:
                continue
            tensors = isinstance(other, torch.Tensor) and isinstance(value, torch.Tensor)
            fits = label in OBJECTS or label == "three zeros"
            if tensors and _alike(other, value) and (fits or torch.equal(other, value)):
                continue  # a valid checkpoint
            if type(other) is type(value) and not isinstance(other, torch.Tensor) and other == value:
                continue
            yield f"{name}: {label}", saved(changed(state, path, other))
    whole = saved(state)
    for _ in range(300 if full else 10):
        data = bytearray(whole)
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        yield "bit flipped", bytes(data)
        yield "cut off", whole[: rng.randrange(len(whole))]


def _alike(one: torch.Tensor, other: torch.Tensor) -> bool:
    """Whether both are of the same kind, shape and dtype."""
    same = type(one) is type(other) and one.layout == other.layout and one.device == other.device
    same = same and not one.is_quantized and not one.is_nested and one.is_contiguous() == other.is_contiguous()
    return same and one.dtype == other.dtype and one.shape == other.shape


def outcome(fresh: Trainer, folder: Path) -> tuple[str, list[str]]:
    """What a resumed run makes of the files in `folder`."""
    messages: list[str] = []
    try:
        content = Checkpoints(folder, lambda: None, messages.append).load(fresh.check)
        assert content is not None
        fresh.load(content)
        if content["step"] == PREVIOUS:
            return "previous", messages
        fresh.take_step(measure=False)
        return "newest", messages
    except StoreError as error:
        return "refused", [str(error)]
    except Diverged as error:
        return "diverged", [str(error)]


def main(folder: Path, config: dict[str, Any], full: bool) -> None:
    warnings.simplefilter("ignore")  # of the odd kinds of tensors
    taken = trainer(config)
    states = {}
    for step in range(1, NEWEST + 1):
        taken.take_step(measure=False)
        states[step] = copy.deepcopy(taken.state())
    previous = saved(states[PREVIOUS])
    for number, (name, data) in enumerate(files(states[NEWEST], full)):
        for path in folder.iterdir():
            path.unlink()
        print(json.dumps({"now": name}), flush=True)
        (folder / "checkpoint.pt").write_bytes(data)
        (folder / "checkpoint.prev.pt").write_bytes(previous)
        result, messages = outcome(taken, folder)
        print(json.dumps({"file": name, "outcome": result, "messages": messages}), flush=True)
        if number % 10 == 0:
            for path in folder.iterdir():
                path.unlink()
            for file in ("checkpoint.pt", "checkpoint.prev.pt"):
                (folder / file).write_bytes(saved(changed(states[NEWEST], ("step",), -5)))
            result, messages = outcome(taken, folder)
            remaining = sorted(path.name for path in folder.iterdir())
            print(json.dumps({"file": "both", "outcome": result, "messages": messages, "files": remaining}), flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), json.loads(Path(sys.argv[2]).read_text()), sys.argv[3] == "full")
