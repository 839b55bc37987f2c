"""What the jobs of a sweep tell the process that started it, and the other way round, on any machine: a folder.

<store>/.sweeps/<time>/
  multirun.yaml    the sweep's configuration, written by Hydra
  failed/3.json    job 3: its overrides and why it failed
  stop             whoever sees it stops with a checkpoint and starts nothing more
  jobs/            scripts and output of a cluster's jobs
"""

import json
from collections.abc import Collection, Sequence
from pathlib import Path


class Sweep:
    """The folder of one sweep; it is made by whoever writes first. `common` are overrides that all jobs have."""

    def __init__(self, folder: str | Path, common: Collection[str] = ()) -> None:
        self.folder = Path(folder)
        self.common = set(common)

    def fail(self, job: int, overrides: Sequence[str], reason: str) -> None:
        path = self.folder / "failed" / f"{job}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps({"overrides": list(overrides), "reason": reason}))

    def failures(self) -> list[tuple[str, str]]:
        """What is particular to each job that failed, and the reason, in the order of the jobs."""
        paths = sorted((self.folder / "failed").glob("*.json"), key=lambda path: int(path.stem))
        failed = [json.loads(path.read_text()) for path in paths]
        return [(self._particular(job["overrides"]), job["reason"]) for job in failed]

    def _particular(self, overrides: Sequence[str]) -> str:
        return " ".join([item for item in overrides if item not in self.common] or overrides)

    def stop(self) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        (self.folder / "stop").touch()

    def stopping(self) -> bool:
        return (self.folder / "stop").exists()
