"""Sweeps by name, and the folder through which the jobs of a sweep report to the process that started it.

The folder works for jobs on any machine that shares the store:

<store>/.sweeps/<time>/
  multirun.yaml    the sweep's configuration, written by Hydra
  failed/3.json    job 3: its overrides and why it failed
  stop             when it exists, jobs stop with a checkpoint and no further job starts
  jobs/            scripts and output of a cluster's jobs
"""

import json
from collections.abc import Collection, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

from qnerf.config.folders import SWEEPS

MAX_FILE_BYTES = 2**18  # of a configuration file
MAX_VALUES = 10_000  # in it, aliases written out


def expand_sweep(arguments: Sequence[str]) -> list[str]:
    """Replaces `--sweep NAME` by the options with which Hydra finds the sweep's file.

    NAME is a sweep that comes with qnerf, or the path of a YAML file.

    Raises:
        ValueError: no such sweep, or no NAME.

    >>> expand_sweep(["--sweep", "seeds", "budget=short"])
    ['-cd', '.../sweeps', '-cn', 'seeds', 'budget=short']
    """
    expanded = []
    rest = iter(arguments)
    for argument in rest:
        option, equals, name = argument.partition("=")
        if option != "--sweep":
            expanded.append(argument)
            continue
        name = name if equals else next(rest, "")
        file = Path(name) if name.endswith(".yaml") else SWEEPS / f"{name}.yaml"
        if not file.is_file():
            known = ", ".join(sorted(sweep.stem for sweep in SWEEPS.glob("*.yaml")))
            raise ValueError(f"--sweep expects a .yaml file or a known sweep, got {name!r}; known: {known}")
        expanded += ["-cd", str(file.parent.absolute()), "-cn", file.stem]
    return expanded


def check_file(file: Path) -> None:
    """ValueError if a configuration file is too large to read, or becomes too large by aliases of its own parts."""
    import yaml  # type: ignore[import-untyped]

    if not file.is_file():
        return  # Hydra will say so
    if file.stat().st_size > MAX_FILE_BYTES:
        raise ValueError(f"{file}: more than {MAX_FILE_BYTES // 2**10} KiB of configuration")
    content = file.read_bytes()
    if b"*" not in content:
        return
    sizes: dict[int, int] = {}

    def size(node: Any) -> int:
        """Number of values of the node with all its aliases written out."""
        if id(node) not in sizes:
            sizes[id(node)] = MAX_VALUES  # an alias of a node that it is in
            children = chain.from_iterable(node.value) if isinstance(node, yaml.MappingNode) else node.value
            sizes[id(node)] = 1 if isinstance(node, yaml.ScalarNode) else 1 + sum(map(size, children))
        return sizes[id(node)]

    try:
        root = yaml.compose(content, Loader=yaml.SafeLoader)
        values = size(root) if root is not None else 0
    except (yaml.YAMLError, ValueError, RecursionError):
        return  # Hydra will say so
    if values > MAX_VALUES:
        raise ValueError(f"{file}: its aliases stand for more than {MAX_VALUES} values")


class Sweep:
    """The folder of one sweep, created by the first write. `common`: overrides of the whole sweep."""

    def __init__(self, folder: str | Path, common: Collection[str] = ()) -> None:
        self.folder = Path(folder)
        self.common = set(common)

    def fail(self, job: int, overrides: Sequence[str], reason: str) -> None:
        path = self.folder / "failed" / f"{job}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps({"overrides": list(overrides), "reason": reason}))

    def failures(self) -> list[tuple[str, str]]:
        """Each failed job's own overrides and the reason, in the order of the jobs."""
        from qnerf.records.files import read_json  # imports pandas, which `qnerf --help` must not wait for

        failed = []
        reports = [path for path in (self.folder / "failed").glob("*.json") if path.stem.isdecimal()]
        for path in sorted(reports, key=lambda path: int(path.stem)):
            try:
                job = read_json(path)
                failed.append((self._own(list(map(str, job["overrides"]))), str(job["reason"])))
            except (OSError, ValueError, KeyError, TypeError) as error:
                failed.append((f"job {path.stem}", f"{path}: cannot be read: {error}"))
        return failed

    def _own(self, overrides: Sequence[str]) -> str:
        return " ".join([item for item in overrides if item not in self.common] or overrides)

    def stop(self) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        (self.folder / "stop").touch()

    def stopping(self) -> bool:
        return (self.folder / "stop").exists()
