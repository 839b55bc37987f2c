"""A Slurm cluster of one node on the loopback: munged, slurmctld and slurmd as root, everything in one folder.

python -m tests.helpers.slurm_cluster COMMAND ...   # runs it with that cluster's SLURM_CONF
"""

import contextlib
import os
import secrets
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch", "srun", "scontrol", "squeue")
SECONDS = 40  # for the daemons to come up, and for jobs to end

CONFIGURATION = """
ClusterName=qnerf
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={controller}
SlurmdPort={daemon}
SlurmUser=root
AuthType=auth/munge
CredType=cred/munge
AuthInfo=socket={folder}/munge.socket,cred_expire=5
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
PlugStackConfig={folder}/plugstack.conf
SlurmdParameters=config_overrides
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
MpiDefault=none
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
SchedulerParameters=batch_sched_delay=0,sched_interval=2,bf_interval=2
ReturnToService=2
KillWait=15
NodeName={host} NodeAddr=127.0.0.1 CPUs={cpus} State=UNKNOWN
PartitionName=all Nodes=ALL Default=YES MaxTime=INFINITE State=UP
"""


def missing() -> str | None:
    """Why no cluster can be started here; None where it can."""
    if not hasattr(os, "geteuid") or os.geteuid() != 0:
        return "needs root: slurmd starts jobs as their user"
    absent = [program for program in PROGRAMS if which(program) is None]
    return f"not installed: {', '.join(absent)}" if absent else None


def which(program: str) -> str | None:
    return shutil.which(program, path=f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin")


@contextlib.contextmanager
def cluster(cpus: int = 2) -> Iterator[Path]:
    """The path of slurm.conf, for SLURM_CONF, while the cluster is up. RuntimeError with the logs where it fails."""
    folder = Path(tempfile.mkdtemp(prefix="qnerf-slurm-"))  # short: sockets have short names
    folder.chmod(0o755)
    conf = _configure(folder, cpus)
    processes: list[subprocess.Popen[bytes]] = []
    try:
        names = {name: str(folder / f"munge.{name}") for name in ("key", "socket", "pid", "log", "seed")}
        munge = [f"--{option}={names[name]}" for option, name in _MUNGE.items()]
        processes.append(_start(folder, "munged", "--foreground", "--force", *munge))
        _wait(folder, lambda: Path(names["socket"]).exists())
        environment = os.environ | {"SLURM_CONF": str(conf)}
        processes.append(_start(folder, "slurmctld", "-D", "-i", "-f", str(conf), env=environment))
        processes.append(_start(folder, "slurmd", "-D", "-f", str(conf), env=environment))
        _wait(folder, lambda: "idle" in _output("sinfo", "-h", "-o", "%t", env=environment))
        try:
            yield conf
        finally:
            _output("scancel", "--user=root", env=environment)
            _wait(folder, lambda: not _output("squeue", "-h", env=environment))  # jobs outlive their daemons
    finally:
        for process in reversed(processes):
            process.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(timeout=10)
            process.kill()
            process.wait()
        shutil.rmtree(folder, ignore_errors=True)


_MUNGE = {"key-file": "key", "socket": "socket", "pid-file": "pid", "log-file": "log", "seed-file": "seed"}


def _configure(folder: Path, cpus: int) -> Path:
    for name in ("state", "spool"):
        (folder / name).mkdir()
    (folder / "plugstack.conf").touch()
    (folder / "munge.key").write_bytes(secrets.token_bytes(128))
    (folder / "munge.key").chmod(0o400)
    conf = folder / "slurm.conf"
    host = socket.gethostname().split(".")[0]
    controller, daemon = _free_ports(2)
    conf.write_text(
        CONFIGURATION.format(folder=folder, host=host, cpus=cpus, controller=controller, daemon=daemon).lstrip()
    )
    return conf


def _free_ports(count: int) -> list[int]:
    with contextlib.ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(count)]
        for item in sockets:
            item.bind(("127.0.0.1", 0))
        return [item.getsockname()[1] for item in sockets]


def _start(folder: Path, program: str, *arguments: str, env: dict[str, str] | None = None) -> "subprocess.Popen[bytes]":
    path = which(program)
    assert path is not None
    with open(folder / f"{program}.out", "wb") as output:
        return subprocess.Popen([path, *arguments], env=env, stdout=output, stderr=subprocess.STDOUT)


def _output(*command: str, env: dict[str, str]) -> str:
    return subprocess.run(command, env=env, capture_output=True, text=True, timeout=30, check=False).stdout


def _wait(folder: Path, ready: Callable[[], bool]) -> None:
    deadline = time.monotonic() + SECONDS
    while not ready():
        if time.monotonic() > deadline:
            logs = [path for pattern in ("*.out", "*.log") for path in sorted(folder.glob(pattern))]
            tails = [f"{path.name}:\n{path.read_text(errors='replace')[-1500:]}" for path in logs]
            raise RuntimeError("the Slurm cluster did not come up, or did not end\n" + "\n".join(tails))
        time.sleep(0.2)


if __name__ == "__main__":
    reason = missing()
    if reason:
        sys.exit(f"no Slurm cluster here: {reason}")
    with cluster(os.cpu_count() or 1) as path:
        sys.exit(subprocess.run(sys.argv[1:], env=os.environ | {"SLURM_CONF": str(path)}, check=False).returncode)
