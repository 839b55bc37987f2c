"""A store to change, the register of its changes, and values that nobody expects."""

import contextlib
import json
import random
import shutil
import stat
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

Random = random.Random

MARK = "qnerf-fuzz"
"""In every hostile HTML text; a page that has it as a tag would run it."""
DEEP = "@deep@"
"""Stands for a value nested too deeply for `json.dumps`."""

TEXTS = (
    "\x1b[31mred\x1b[0m\x07", "\x1b]0;title\x07", "\x9b31m", "\r\nerror: false", "a\nb\tc", "\x00", "\u202egpj.exe",
    "\u2066", "\ud800", "e\u0301" * 50, "\U0001f986", "١٢٣", "$\\frac{", "$x^{", "$$", "\\input{/etc/passwd}", "%s%n",
    "{0.__class__}", "[bold red]markup[/]", "[/]", f"<{MARK} onload=alert(1)>", f"</script><{MARK}>",
    "=cmd|' /C calc'!A0", "+1+1", "@SUM(1)", "a" * 100_000, "../../outside/new", "/etc/passwd", "null", "nan",
    "1e999", "2024-02-30", "", " ", "-rf", "--store", "0x10", "x,y;\"z'", "${oc.env:HOME}",
    "!!python/object/apply:os.system [id]", "???", "a=b", "|", "`id`",
)  # fmt: skip
NUMBERS = (
    0, 1, -1, 3, 2**31, 2**53 + 1, 2**63 - 1, 2**63, -(2**63), 2**64, 10**400, -0.0, 0.5, 1e-320, 1e-310, 1e16,
    253402300800.0, 1e308, -1e308, float("nan"), float("inf"), float("-inf"),
)  # fmt: skip


def value(rng: Random) -> Any:
    """Anything that JSON can hold, mostly what nobody expects."""
    simple = (None, True, False, [], {}, DEEP, [None], [[]], {"": None}, {"a": {"b": {"c": 1}}}, [1] * 10_000)
    return rng.choice((rng.choice(TEXTS), rng.choice(NUMBERS), rng.choice(simple)))


def dumped(content: Any) -> bytes:
    text = json.dumps(content)
    return text.replace(f'"{DEEP}"', "[" * 50_000 + "]" * 50_000).encode(errors="surrogatepass")


@dataclass
class Store:
    """A store to change.

    root: the store. outside: a folder with a copy of the store and of pictures and tables, not to be touched.
    targets: names in the store whose content was changed.
    """

    root: Path
    outside: Path
    targets: list[str] = field(default_factory=list)

    def paths(self, pattern: str = "**/*") -> list[Path]:
        """What matches, but for what is reached through a link."""
        return sorted(path for path in self.root.glob(pattern) if not self.is_behind_a_link(path))

    def is_behind_a_link(self, path: Path) -> bool:
        above = path.relative_to(self.root).parents
        return any((self.root / part).is_symlink() for part in above)

    def runs(self) -> list[Path]:
        folders = (path for path in self.paths("*") if path.is_dir() and not path.is_symlink())
        return [path for path in folders if not path.name.startswith(".")]

    def run(self, rng: Random) -> Path:
        return self.touched(rng.choice(self.runs() or [self.root]))

    def file(self, rng: Random, *patterns: str) -> Path:
        """One of the regular files that match."""
        found = [path for pattern in patterns for path in self.paths(pattern) if is_regular(path)]
        if not found:
            raise Skipped
        kinds = sorted({path.name for path in found})  # the kind first: there are more of some than of others
        kind = rng.choice(kinds)
        return self.touched(rng.choice([path for path in found if path.name == kind]))

    def any(self, rng: Random) -> Path:
        """A file or a folder, at any level."""
        found = self.paths()
        if not found:
            raise Skipped
        kind = rng.choice(sorted({path.relative_to(self.root).parts[1:] or path.name[:1] for path in found}, key=str))
        found = [path for path in found if (path.relative_to(self.root).parts[1:] or path.name[:1]) == kind]
        return self.touched(rng.choice(found))

    def touched(self, path: Path) -> Path:
        self.targets += path.relative_to(self.root).parts[:1]
        return path

    def label(self, path: Path) -> str:
        """The path in messages: runs by the first word of their id that tells them apart."""
        return ascii(str(path.relative_to(self.root)))[1:-1] or "."


class Skipped(Exception):
    """The store has nothing that this mutation could change."""


Mutation = Callable[[Store, Random], str]
MUTATIONS: dict[str, Mutation] = {}


def mutation(function: Mutation) -> Mutation:
    MUTATIONS[function.__name__] = function
    return function


def is_regular(path: Path) -> bool:
    with contextlib.suppress(OSError, ValueError):
        return stat.S_ISREG(path.lstat().st_mode)
    return False


def shares_a_file(path: Path) -> bool:
    """Whether a file has another name, which may lie outside the store."""
    return path.is_file() and path.stat().st_nlink > 1


def remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def bytes_of(path: Path) -> bytes:
    if path.stat().st_size > 2**24:
        raise Skipped
    return path.read_bytes()


def put(path: Path, data: bytes) -> None:
    """A new file in the place of the old one, so that other names of the old one keep their content."""
    remove(path)
    path.write_bytes(data)
