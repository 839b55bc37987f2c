"""Links, things that are no files, names, copies and times."""

# ruff: noqa: RUF001 (digits of other scripts are wanted)

import contextlib
import os
import shutil
import socket
import stat
from collections.abc import Callable
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from tests.faults.mutations.store import (
    MARK,
    TEXTS,
    Random,
    Skipped,
    Store,
    is_regular,
    mutation,
    remove,
    shares_a_file,
)


def outside_of(store: Store, path: Path, rng: Random) -> Path:
    """Something outside that looks like `path`, or something else."""
    twin = store.outside / "store" / path.relative_to(store.root)
    others = sorted(store.outside.rglob("*"))
    return twin if twin.exists() and rng.random() < 0.6 else rng.choice(others)


@mutation
def link(store: Store, rng: Random) -> str:
    path = store.any(rng)
    there = outside_of(store, path, rng)
    remove(path)
    path.symlink_to(there)
    return f"{store.label(path)} -> outside/{ascii(str(there.relative_to(store.outside)))[1:-1]}"


@mutation
def link_folder(store: Store, rng: Random) -> str:
    """One of the folders that commands write into or tidy, as a link."""
    names = (".tmp", ".index", "owner", "metrics", "images", ".annotations", ".annotations/owner")
    name = rng.choice(names)
    path = (store.root if name in (".tmp", ".index") else store.run(rng)) / name
    if not path.parent.is_dir() or path.parent.is_symlink():
        raise Skipped
    there = outside_of(store, path, rng)
    remove(path)
    path.symlink_to(there)
    return f"{store.label(path)} -> outside/{ascii(str(there.relative_to(store.outside)))[1:-1]}"


@mutation
def new_link(store: Store, rng: Random) -> str:
    """A link under a name that commands write, read or delete."""
    names = (
        "log.txt", "annotations.json", "checkpoint.prev.pt", "environment-2.json", "dirty.diff", "nonfinite.pt",
        "eval_hardware.parquet", "images/linked.png", "metrics/part-00001.parquet", "owner/000009.json",
        ".status.json.0a0a0a0a.tmp", ".annotations",
    )  # fmt: skip
    folder, name = rng.choice(
        ((store.run(rng), rng.choice(names)), (store.root, rng.choice((".tmp/old-x", ".tmp/new-x", "linked-run"))))
    )
    path = folder / name
    if not path.parent.is_dir() or path.parent.is_symlink():
        raise Skipped
    remove(path)
    there = rng.choice((outside_of(store, path, rng), store.outside / "absent"))
    path.symlink_to(there)
    store.touched(path)
    return f"{store.label(path)} -> outside/{ascii(str(there.relative_to(store.outside)))[1:-1]}"


@mutation
def odd_link(store: Store, rng: Random) -> str:
    """A loop, a dangling link, a device, a part of the store."""
    path = store.any(rng)
    there = rng.choice(
        (path, path.parent, "..", ".", "nowhere", "/dev/zero", "/dev/full", "/dev/stdin", "/proc/self/mem",
         "/proc/self/fd/0", "", store.root, str(store.any(rng)), "x" * 300)
    )  # fmt: skip
    remove(path)
    try:
        path.symlink_to(there)
    except OSError:
        raise Skipped from None
    return f"{store.label(path)} -> {str(there).replace(str(store.root), 'STORE')[:60]}"


@mutation
def special(store: Store, rng: Random) -> str:
    """A pipe, a socket, a device, or a folder in place of a file and the reverse."""
    path = store.any(rng)
    was_folder = path.is_dir()
    remove(path)
    how = rng.choice(("pipe", "socket", "device", "folder", "file", "tree"))
    if how == "pipe":
        os.mkfifo(path)
    elif how == "socket":
        with socket.socket(socket.AF_UNIX) as server, contextlib.chdir(path.parent):
            server.bind(path.name[:90])
    elif how == "device":
        try:
            os.mknod(path, 0o666 | stat.S_IFCHR, os.makedev(1, rng.choice((3, 5, 7))))
        except PermissionError:
            os.mkfifo(path)
    elif how == "folder" or (how == "file" and not was_folder):
        path.mkdir()
    elif how == "file":
        path.write_bytes(rng.choice((b"", b"x", b"{}")))
    else:
        (path / "a" / path.name).mkdir(parents=True)
        (path / "a" / "file").write_bytes(b"x")
    return f"{store.label(path)} is a {how}"


@mutation
def hard_link(store: Store, rng: Random) -> str:
    """A file that is also outside, as in a backup of hard links."""
    path = store.file(rng, "**/*")
    twin = store.outside / "store" / path.relative_to(store.root)
    if not is_regular(twin):
        raise Skipped
    remove(path)
    os.link(twin, path)
    return f"{store.label(path)} is a hard link to the file outside"


@mutation
def permissions(store: Store, rng: Random) -> str:
    if os.geteuid() == 0:
        raise Skipped
    path = store.any(rng)
    if shares_a_file(path):
        raise Skipped
    mode = rng.choice((0, 0o444, 0o222, 0o111, 0o555))
    path.chmod(mode)
    return f"{store.label(path)} has mode {mode:o}"


@mutation
def copies(store: Store, rng: Random) -> str:
    """What file managers and sync programs leave."""
    path = store.any(rng)
    stem, suffix = path.stem, path.suffix
    name = rng.choice(
        (f"{stem} (1){suffix}", f"{stem}.sync-conflict-20260101{suffix}", f"{path.name}~", f".{path.name}.swp",
         f"._{path.name}", f"{path.name}\n", f"{stem}\u0661{suffix}", f"{path.name}.bak", path.name.upper(),
         f"{path.name}.partial", f" {path.name}", f".{path.name}.0a0a0a0a.tmp")
    )  # fmt: skip
    copy = path.with_name(name[:250])
    if os.path.lexists(copy):
        raise Skipped
    if path.is_dir() and not path.is_symlink():
        shutil.copytree(path, copy, symlinks=True)
    elif is_regular(path):
        shutil.copy2(path, copy)
    else:
        raise Skipped
    store.touched(copy)
    return f"{ascii(copy.name)[:80]} beside {store.label(path)}"


def hostile_name(rng: Random) -> bytes:
    texts = [text for text in TEXTS if text and "/" not in text and "\x00" not in text and len(text) < 200]
    extra = (
        b"\xff\xfe",
        b"x" * 255,
        b"a\nb",
        b"(1)",
        b"C:\\x",
        b"--yes",
        b"~",
        b"*",
        b"con",
        b"a" * 200 + b"-0123456789",
    )
    return rng.choice(
        (*extra, rng.choice(texts).encode(errors="surrogatepass"), rng.choice(texts).encode(errors="surrogatepass"))
    )


@mutation
def renamed(store: Store, rng: Random) -> str:
    """A run, a picture or a table under a name that qnerf would not choose."""
    path = rng.choice((store.run(rng), store.run(rng), store.any(rng)))
    name = hostile_name(rng)
    new = Path(os.fsdecode(os.path.join(os.fsencode(path.parent), name)))
    if path == store.root or os.path.lexists(new):
        raise Skipped
    old = store.label(path)
    os.rename(path, new)
    store.touched(new)
    return f"{old} is called {name!a}"


@mutation
def named_part(store: Store, rng: Random) -> str:
    """A part of the metrics or a picture under an odd name."""
    folder = store.run(rng) / rng.choice(("metrics", "images"))
    files = [path for path in sorted(folder.glob("*")) if is_regular(path)] if not folder.is_symlink() else []
    if not files:
        raise Skipped
    names = (
        "part-00000 (1).parquet", "part-٠٠٠٠١.parquet", "part-99999999999999999999.parquet", "part--1.parquet",
        "part-.parquet", "part-00001.parquet\n", "part-1.parquet", "part-00001.txt", "part-00000.parquet.crc",
        ".part-00001.parquet", "_SUCCESS", "a b.png", "$x^{.png", "\x1b[31m.png", f"<{MARK}>.png", "a.PNG",
        "a.png.png", ".png", "a\nb.png", "x" * 250 + ".png",
    )  # fmt: skip
    path = folder / rng.choice(names)
    if os.path.lexists(path):
        raise Skipped
    shutil.copy2(rng.choice(files), path)
    return f"{store.label(folder)}/{ascii(path.name)[:60]} added"


@mutation
def strangers(store: Store, rng: Random) -> str:
    """Files and folders in the store that are no runs, or look like something else."""

    def folder_with(name: str, file: str, data: bytes) -> None:
        (store.root / name).mkdir()
        (store.root / name / file).write_bytes(data)

    kinds: dict[str, Callable[[], object]] = {
        ".DS_Store": lambda: (store.root / ".DS_Store").write_bytes(b"\x00\x01"),
        "runs.parquet": lambda: (store.root / "runs.parquet").write_bytes(rng.choice((b"", b"PAR1", b"x"))),
        "views.parquet": lambda: pq.write_table(pa.table({"a": [1]}), store.root / "views.parquet"),
        "empty": lambda: (store.root / "empty").mkdir(),
        "project": lambda: folder_with("project", "config.yaml", b"a: 1\n"),
        "marked": lambda: folder_with("marked", "status.json", b"{}"),
        "nested": lambda: shutil.copytree(store.run(rng), store.run(rng) / "nested", symlinks=True),
        "zeros": lambda: folder_with("zeros", "summary.parquet", bytes(100)),
        "old": lambda: shutil.copytree(store.run(rng), store.root / ".tmp" / "old-x-00000000", symlinks=True),
        "file": lambda: (store.root / "a-file").write_bytes(b"x"),
    }  # fmt: skip
    name = rng.choice(sorted(kinds))
    try:
        kinds[name]()
    except (OSError, shutil.Error):
        raise Skipped from None
    store.targets.append(name)
    return f"{name} added to the store"


@mutation
def times(store: Store, rng: Random) -> str:
    path = store.any(rng)
    if path.is_symlink() or shares_a_file(path):
        raise Skipped
    moment = rng.choice((0, -1, -(2**31), 2**31, 2**33, 253402300800, 2**40))
    try:
        os.utime(path, (moment, moment))
    except (OSError, OverflowError):
        raise Skipped from None
    return f"{store.label(path)} is of {moment}"
