"""Pictures and checkpoints."""

import io
import os
import struct
import zipfile
import zlib
from collections.abc import Callable
from typing import Any

import torch

from tests.faults.mutations.store import MARK, Random, Skipped, Store, bytes_of, mutation, put


def png(width: int, height: int, *chunks: bytes, data: bytes = b"", depth: int = 8, colour: int = 2) -> bytes:
    header = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0)
    parts = [b"IHDR" + header, *chunks, b"IDAT" + zlib.compress(data), b"IEND"]
    packed = (struct.pack(">I", len(part) - 4) + part + struct.pack(">I", zlib.crc32(part)) for part in parts)
    return b"\x89PNG\r\n\x1a\n" + b"".join(packed)


@mutation
def picture(store: Store, rng: Random) -> str:
    path = store.file(rng, "*/images/*")
    data = bytes_of(path)
    pictures = {
        "eps": b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 10 10\n%%EndComments\n(x) show\n%%EOF\n",
        "400 megapixels": png(20_000, 20_000),
        "huge": png(2**31 - 1, 2**31 - 1),
        "empty": png(0, 0),
        "one pixel": png(1, 1, data=b"\0\0\0\0"),
        "line": png(100_000, 1, data=bytes(300_001)),
        "animation": png(4, 4, b"acTL" + struct.pack(">II", 10**6, 0), data=bytes(52)),
        "text bomb": png(4, 4, b"zTXta\0\0" + zlib.compress(bytes(10**8)), data=bytes(52)),
        "bomb": png(8000, 8000, data=bytes(8000 * 24_001)),
        "sixteen bits": png(4, 4, depth=16, colour=0, data=bytes(36)),
        "palette": png(4, 4, colour=3, data=bytes(20)),
        "odd depth": png(4, 4, depth=3, data=bytes(20)),
        "truncated": data[: len(data) * 2 // 3],
        "gif": b"GIF89a"
        + bytes([1, 0, 1, 0, 128, 0, 0, 0, 0, 0, 255, 255, 255, 44, 0, 0, 0, 0, 1, 0, 1, 0, 0, 2, 2, 68, 1, 0, 59]),
        "svg": f"<svg xmlns='http://www.w3.org/2000/svg' onload='alert(1)'><{MARK}/></svg>".encode(),
        "html": f"<html><{MARK}>".encode(),
        "tiff": b"II*\x00\x08\x00\x00\x00\xff\xff",
    }
    how = rng.choice(sorted(pictures))
    put(path, pictures[how])
    return f"{store.label(path)} is a picture: {how}"


def leaves(node: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Paths of everything in a checkpoint, containers included."""
    inner = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    return [path] * bool(path) + [leaf for key, child in inner for leaf in leaves(child, (*path, key))]


@mutation
def checkpoint(store: Store, rng: Random) -> str:
    """One leaf of a checkpoint, of another shape, type or value."""
    path = store.file(rng, "*/checkpoint*.pt")
    try:
        content = torch.load(io.BytesIO(bytes_of(path)), weights_only=True)
    except Exception:  # of any kind, where it was damaged before
        raise Skipped from None
    paths = leaves(content)
    if not paths:
        raise Skipped
    *parents, key = rng.choice(paths if rng.random() < 0.5 else [leaf for leaf in paths if len(leaf) == 1])
    node = content
    for parent in parents:
        node = node[parent]
    old = node[key]
    if isinstance(old, torch.Tensor) and rng.random() < 0.85:
        changes: dict[str, Callable[[], Any]] = {
            "shorter": lambda: old.flatten()[:-1].clone(),
            "longer": lambda: torch.cat([old.flatten(), old.flatten()]),
            "three": lambda: torch.zeros(3),
            "scalar": lambda: torch.tensor(1.0),
            "empty": lambda: torch.zeros(0),
            "transposed": lambda: old.reshape(old.shape[::-1]),
            "nan": lambda: torch.full_like(old, float("nan")) if old.is_floating_point() else old + 1,
            "huge": lambda: torch.full(old.shape, 1e38) if old.is_floating_point() else torch.full_like(old, 127),
            "int": lambda: old.to(torch.int64),
            "double": lambda: old.to(torch.float64),
            "complex": lambda: old.to(torch.complex64),
            "half": lambda: old.to(torch.bfloat16),
            "sparse": lambda: old.to_sparse(),
            "stride": lambda: torch.zeros(1, dtype=old.dtype).expand(old.shape),
            "meta": lambda: old.to("meta"),
        }
        how = rng.choice(sorted(changes))
        try:
            new = changes[how]()
        except (RuntimeError, NotImplementedError):
            raise Skipped from None
    elif rng.random() < 0.2:
        how, new = "removed", None
    else:
        new = rng.choice(
            (
                None,
                -5,
                0,
                2,
                10**6,
                2**70,
                1.5,
                float("nan"),
                "x",
                [],
                {},
                torch.tensor(2),
                torch.zeros(3),
                True,
                [1.0, "x"],
            )
        )
        how = ascii(new)[:30]
    if how == "removed":
        del node[key]
    else:
        node[key] = new
    sink = io.BytesIO()
    try:
        torch.save(content, sink)
    except Exception:  # such as a tensor without data
        raise Skipped from None
    put(path, sink.getvalue())
    where = ".".join(map(str, (*parents, key)))
    return f"{store.label(path)}: {where} {how}"


@mutation
def checkpoint_whole(store: Store, rng: Random) -> str:
    path = store.file(rng, "*/checkpoint*.pt")
    kinds: dict[str, Callable[[Any], object]] = {
        "a list": lambda sink: torch.save([1, 2], sink),
        "an empty dict": lambda sink: torch.save({}, sink),
        "a tensor": lambda sink: torch.save(torch.zeros(3), sink),
        "code": lambda sink: torch.save({"step": os.system}, sink),
        "an old format": lambda sink: torch.save({"step": 2}, sink, _use_new_zipfile_serialization=False),
        "a bomb": lambda sink: _zip(sink, {"archive/data.pkl": bytes(10**7), "archive/version": b"3"}),
        "no pickle": lambda sink: _zip(sink, {"archive/version": b"3"}),
        "deep": lambda sink: _zip(
            sink, {"archive/data.pkl": b"\x80\x02" + b"]" * 100_000 + b".", "archive/version": b"3"}
        ),
    }
    how = rng.choice(sorted(kinds))
    sink = io.BytesIO()
    kinds[how](sink)
    put(path, sink.getvalue())
    return f"{store.label(path)} is {how}"


def _zip(sink: Any, files: dict[str, bytes]) -> None:
    with zipfile.ZipFile(sink, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in files.items():
            archive.writestr(name, data)
