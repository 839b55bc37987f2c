"""The run store: one folder per run, readable with pandas.

    runs/<run_id>/
      config.yaml          the resolved configuration
      overrides.txt        what the user typed
      environment.json     code, packages, machine; dirty.diff: changes since the commit
      status.json          state, step, heartbeat, owner, error, and the row of summary.parquet
      metrics/             part-00000.parquet ...: step int64, time_s float64, key string, value float64
      eval.parquet         one row per evaluated image
      summary.parquet      one row: final metrics, parameter counts, timings, the flat configuration
      images/  log.txt     pictures and messages
      preview.png          truth, rendering, error and depth of one view, from while it trains
      dataparser_transforms.json  from the scene's own world to the normalised one, as nerfstudio writes it
      checkpoint.pt        and the one before it, checkpoint.prev.pt
      owner/               who may write (`owner.py`)
    runs/.index/           what `index` read of all runs
    runs/.new-*            a folder that is being made; .deleted-*: one that is being deleted

Who may write. `RunStore.claim` gives a run to one process, and only this owner writes into the folder. Everybody may
read it at any moment. The index is written by whoever reads the store.

What a reader sees. A file is never changed in place: the new version is written under a temporary name and renamed.
pandas and DuckDB open a Parquet file twice and fail if it was replaced in between. While a run trains, use the readers
of this package, or read again. A column's type is declared, so the tables of all runs can be read as one.

What survives kill -9. Everything that was written: at most the metrics of the last few seconds are lost, and the run
resumes from its last checkpoint. The rows logged after that checkpoint are dropped, so that no step appears twice. The
next claim removes the temporary files.

What a damaged file does. A run whose results cannot be read is one damaged row of a table. If the checkpoint is
damaged, the one before it is used. Any other file that is needed to go on is named in one line: deleted, it is made
again, or its rows are missing.

What a folder of another person can do. Nothing in it is executed. Only what this package made is deleted
(`deletion.py`).

The file system must rename files and folders atomically and create hard links (or at least files) exclusively. Local
file systems, NFS, Lustre, GPFS and SMB do; object stores mounted as folders do not.
"""

from qnerf.records.files import StoreError
from qnerf.records.find import find
from qnerf.records.owner import HEARTBEAT_LIMIT
from qnerf.records.read import read_config, read_metrics, read_status, read_summary, runs, state
from qnerf.records.store import Claim, RunStore
from qnerf.records.writer import Run

__all__ = [
    "HEARTBEAT_LIMIT",
    "Claim",
    "Run",
    "RunStore",
    "StoreError",
    "find",
    "read_config",
    "read_metrics",
    "read_status",
    "read_summary",
    "runs",
    "state",
]
