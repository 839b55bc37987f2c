"""Bytes, lengths, JSON, YAML and texts."""

# ruff: noqa: RUF001 (digits of other scripts are wanted)

import json
import os
from typing import Any

import yaml  # type: ignore[import-untyped]

from tests.faults.mutations.store import (
    DEEP,
    TEXTS,
    Random,
    Skipped,
    Store,
    bytes_of,
    dumped,
    mutation,
    put,
    remove,
    value,
)


@mutation
def flip(store: Store, rng: Random) -> str:
    path = store.file(rng, "**/*")
    data = bytearray(bytes_of(path))
    for _ in range(rng.choice((1, 1, 4, 40))):
        if data:
            data[rng.choice((rng.randrange(len(data)), -1 - rng.randrange(min(len(data), 200))))] ^= 1 << rng.randrange(
                8
            )
    put(path, bytes(data))
    return f"bits of {store.label(path)} flipped"


@mutation
def cut(store: Store, rng: Random) -> str:
    path = store.file(rng, "**/*")
    data = bytes_of(path)
    length = rng.choice((0, 1, 4, 8, len(data) // 2, max(len(data) - 1, 0), rng.randrange(len(data) + 1)))
    put(path, data[:length])
    return f"{store.label(path)} cut to {length} bytes"


@mutation
def lengthen(store: Store, rng: Random) -> str:
    path = store.file(rng, "**/*")
    data = bytes_of(path)
    how = rng.choice(("doubled", "zeros", "bom", "utf16", "sparse", "garbage", "newline"))
    if how == "sparse":
        put(path, data)
        os.truncate(path, rng.choice((2**20 + 1, 2**26 + 1, 2**28 + 1, 2**32)))
    elif how == "utf16":
        put(path, data.decode(errors="replace").encode("utf-16"))
    else:
        before = {"bom": b"\xef\xbb\xbf", "newline": b"\r\n"}.get(how, b"")
        after = {"doubled": data, "zeros": bytes(1000), "garbage": rng.randbytes(1000)}.get(how, b"")
        put(path, before + data + after)
    return f"{store.label(path)}: {how}"


@mutation
def exchange(store: Store, rng: Random) -> str:
    """The content of another file."""
    path, other = store.file(rng, "**/*"), store.file(rng, "**/*")
    put(path, bytes_of(other))
    return f"{store.label(path)} holds {store.label(other)}"


@mutation
def missing(store: Store, rng: Random) -> str:
    path = store.any(rng)
    remove(path)
    return f"{store.label(path)} removed"


def changed_object(content: Any, rng: Random) -> str:
    """Changes one value or key somewhere in a JSON object; returns where."""
    where, node = "", content
    while isinstance(node, (dict, list)) and node:
        key: Any = rng.choice(list(node) if isinstance(node, dict) else range(len(node)))
        where = f"{where}.{key}"
        inner = node[key]
        if isinstance(inner, (dict, list)) and inner and rng.random() < 0.8:
            node = inner
            continue
        new = value(rng)
        kind = rng.random()
        if isinstance(node, dict) and kind < 0.1:
            del node[key]
            return f"{where} removed"
        if isinstance(node, dict) and kind < 0.2:
            node[rng.choice(TEXTS)] = new
            return f"{where} has a new neighbour {ascii(new)[:80]}"
        node[key] = new
        return f"{where} is {ascii(new)[:80]}"
    return where


JSON_FILES = (
    "*/status.json",
    "*/annotations.json",
    "*/environment*.json",
    "*/owner/*.json",
    "**/.annotations/owner/*.json",
)


@mutation
def json_value(store: Store, rng: Random) -> str:
    path = store.file(rng, *JSON_FILES)
    try:
        content = json.loads(bytes_of(path))
    except ValueError:
        raise Skipped from None
    where = changed_object(content, rng)
    put(path, dumped(content))
    return f"{store.label(path)}: {where}"


@mutation
def json_whole(store: Store, rng: Random) -> str:
    path = store.file(rng, *JSON_FILES)
    texts = (
        b"[" * 100_000, b'{"a":' * 100_000 + b"1" + b"}" * 100_000, b"1" * 10_000, b'{"step": 1' + b"0" * 5000 + b"}",
        b"NaN", b"null", b"[]", b'""', b"{}", b'{"state": "running"}', b'{"state": "finished"}', b'{"a": 1, "a": 2}',
        b"\xff\xfe", b'{"a": "\\ud800"}', b"", b" ", b"// comment\n{}",
        b'{"state": "failed", "error": "\\u001b[31m"}',
    )  # fmt: skip
    text = rng.choice(texts)
    put(path, text)
    return f"{store.label(path)} is {text[:40]!r}"


@mutation
def yaml_value(store: Store, rng: Random) -> str:
    path = store.file(rng, "*/config.yaml")
    try:
        content = yaml.safe_load(bytes_of(path))
    except (yaml.YAMLError, ValueError):
        raise Skipped from None
    if not isinstance(content, dict):
        raise Skipped
    if rng.random() < 0.1:
        content[rng.choice((None, 1, 1.5, True, (1, 2)))] = value(rng)
        where = "a key that is no text"
    else:
        where = changed_object(content, rng)
    text = yaml.safe_dump(content, sort_keys=False, allow_unicode=True)
    put(path, text.replace(DEEP, "[" * 2000 + "]" * 2000).encode(errors="surrogatepass"))
    return f"{store.label(path)}: {where}"


@mutation
def yaml_whole(store: Store, rng: Random) -> str:
    path = store.file(rng, "*/config.yaml")
    texts = (
        b"a: &a [x, x]\nb: &b [*a, *a]\nc: [*b, *b]\n", b"!!python/object/apply:os.system ['id']", b"null: 1\n",
        b"[]", b"- a\n- b\n", b"a: 2024-02-30\n", b"? [a, b]\n: c\n", b"%YAML 9.9\n---\na: 1\n", b"a: 1\n---\nb: 2\n",
        b"{" * 5000, b"a: " + b"[" * 5000, b"a: !!binary Zm9v\n", b"a: 1\na: 2\n", b"\x00", b"<<: {a: 1}\n",
        b"a: .nan\nb: .inf\n", b"a: 1_000\nb: 0o17\nc: 1:30\n", b"seed: 0\ntrain: null\nscene: null\n",
        b"plugins: [os]\n", b"x: " + b"1" * 5000, b"a: !!timestamp 9999-99-99\n", b"a: !!int 0x\n",
    )  # fmt: skip
    data = bytes_of(path)
    text = rng.choice(texts)
    put(path, text if rng.random() < 0.6 else data + text)
    return f"{store.label(path)} with {text[:40]!r}"


@mutation
def text_file(store: Store, rng: Random) -> str:
    name = rng.choice(("overrides.txt", "dirty.diff", "log.txt", "annotations.json"))
    path = store.run(rng) / name
    text = rng.choice(TEXTS)
    if name == "annotations.json":
        content = {"tags": [text, rng.choice(TEXTS), value(rng)], "note": rng.choice((text, value(rng)))}
        put(path, dumped(content))
    else:
        put(path, text.encode(errors="surrogatepass") * rng.choice((1, 3)))
    return f"{store.label(path)} with {ascii(text)[:40]}"


@mutation
def forged_state(store: Store, rng: Random) -> str:
    """A state that the files do not bear out."""
    run = store.run(rng)
    path = run / "status.json"
    try:
        status = json.loads(bytes_of(path))
    except (OSError, ValueError):
        status = {}
    if not isinstance(status, dict):
        status = {}
    moments = (0, -1, 1e9, 1e12, 1e17, 1e308, -1e308, 2**40, None, "2026-01-01T00:00:00+14:00", float("nan"), True)
    changes: dict[str, Any] = {
        "state": rng.choice(("finished", "running", "failed", "interrupted", "damaged", "", None, 1)),
        "heartbeat": rng.choice(moments),
        "created": rng.choice(moments),
        "step": rng.choice((-5, 0, 2, 10**6, 2**63, 1.5, float("nan"), "3", None, [])),
        "pid": rng.choice((0, 1, -1, os.getpid(), 2**31, 2**64, "1", None)),
        "host": rng.choice((*TEXTS, "elsewhere", None, 3)),
        "format": rng.choice((1, 2, 10**30, -1, "1", None, [], 1.5)),
        "error": rng.choice((*TEXTS, 3, ["x"])),
    }
    chosen = rng.sample(sorted(changes), rng.randrange(1, 5))
    status |= {key: changes[key] for key in chosen}
    put(path, dumped(status))
    return f"{store.label(path)}: " + ", ".join(f"{key}={ascii(changes[key])[:40]}" for key in chosen)


@mutation
def owner_files(store: Store, rng: Random) -> str:
    folder = store.run(rng) / rng.choice(("owner", "owner", ".annotations/owner"))
    odd = not folder.parent.is_dir() or (folder.exists() and not folder.is_dir())
    if odd or store.is_behind_a_link(folder / "file"):
        raise Skipped
    folder.mkdir(exist_ok=True)
    record = {
        "pid": rng.choice((os.getppid(), 1, 0, -1, 2**70, "x", None)), "host": rng.choice(("elsewhere", *TEXTS[:6])),
        "boot": "b", "started": "1", "nonce": rng.choice(("n", None, [], 1)),
        "since": rng.choice((0, 1e308, None, "x", 4e9)), "released": rng.choice((False, True, "no", None)),
    }  # fmt: skip
    name = rng.choice(
        ("0000000000009.json", "٠٠٠٠٠٩.json", "000009 (1).json", "999999999999999999999999.json", "-00001.json",
         "9.json", "000009.json\n", "000009.JSON", "９９９９.json", "000009.json", "1000000.json", ".000009.json.0.tmp",
         "9" * 240 + ".json")
    )  # fmt: skip
    (folder / name).write_bytes(rng.choice((dumped(record), dumped(record), b"", b"{}", b"[]", b"\xff")))
    return f"{store.label(folder)}/{ascii(name)[:50]} added"
