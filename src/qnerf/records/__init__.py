"""The run store: one folder a run, readable with pandas at every moment, one owner a run, nothing lost on kill.

    runs/<run_id>/
      config.yaml overrides.txt environment.json log.txt images/
      status.json        state, step, heartbeat, pid, host, error; format of the store, identity of the configuration
      metrics/           part-00000.parquet ...: step int64, time_s float64, key string, value float64
      eval.parquet       one row an evaluated image
      summary.parquet    one row: final metrics, parameter counts, timings, the flat configuration
      checkpoint.pt      and checkpoint.prev.pt, the one before
      annotations.json   tags and note: the one file that others than the owner write
      owner/             who may write, see `owner.py`
    runs/.tmp/           folders on their way in or out

Files are replaced, never changed in place; a reader that finds another version of a table than it began with gets the
old one whole (`stable.py`). No file of a run is a link, and none is read through one.

What the file system must do: create hard links (or, failing that, files) exclusively and rename files and folders
atomically. Local file systems, NFS, Lustre, GPFS and SMB do; object stores mounted as folders do not.
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
