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
from pathlib import Path

from qnerf.config.folders import SWEEPS


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
        from qnerf.records.numbered import NumberedFiles

        failed = []
        try:
            reports = NumberedFiles("", 1, ".json").in_folder(self.folder / "failed")
        except FileNotFoundError:
            return []
        for number, path in reports.items():
            try:
                job = read_json(path)
                failed.append((self._own(list(map(str, job["overrides"]))), str(job["reason"])))
            except (OSError, ValueError, KeyError, TypeError) as error:
                failed.append((f"job {number}", f"{path}: cannot be read: {error}"))
        return failed

    def _own(self, overrides: Sequence[str]) -> str:
        return " ".join([item for item in overrides if item not in self.common] or overrides)

    def stop(self) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        (self.folder / "stop").touch()

    def stopping(self) -> bool:
        return (self.folder / "stop").exists()
