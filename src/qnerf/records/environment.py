"""Where a run is computed: code, packages, machine, threads."""

import os
import platform
import subprocess
import sys
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

from qnerf.config.identity import flatten

PACKAGES = (
    "qnerf", "torch", "numpy", "scipy", "pennylane", "pennylane-lightning", "numba", "llvmlite", "pandas", "pyarrow",
    "hydra-core", "omegaconf", "pyyaml", "scikit-image", "pillow",
)  # fmt: skip
VARIABLES = (
    "OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS", "NUMBA_DISABLE_JIT",
    "CUDA_VISIBLE_DEVICES", "CUBLAS_WORKSPACE_CONFIG", "SLURM_JOB_ID",
)  # fmt: skip
DIFF_LIMIT = 4_000_000  # characters of a saved diff, about
SOURCES = (".py", ".yaml", ".yml", ".toml")  # untracked files that a diff includes whole; others are only named


def checkout() -> Path | None:
    """Root of the git checkout that this package runs from; None if it was installed."""
    root = Path(__file__).resolve().parents[3]
    # An installed copy may lie inside somebody else's repository, which has another layout.
    is_ours = (root / "pyproject.toml").is_file() and (root / "src" / "qnerf").is_dir()
    return root if is_ours and (root / ".git").exists() else None


def capture(seed: int | None = None, root: Path | None = None) -> dict[str, Any]:
    """The environment as plain values: git, packages, how PyTorch was built, python, platform, cpu, gpu, threads, seed,
    variables, command. Unknown values are None.

    root: a git checkout, by default the one of this package.
    """
    import torch

    cuda = torch.cuda.is_available()
    return {
        "git": _git_state(root or checkout()),
        "packages": {name: _version(name) for name in PACKAGES},
        "torch": {
            "commit": torch.version.git_version,
            "build": [line.strip() for line in torch.__config__.show().splitlines()],
            "matmul_precision": torch.get_float32_matmul_precision(),
        },
        "python": platform.python_version(),
        "platform": platform.platform(),
        "host": platform.node(),
        "cpu": {
            "model": _cpu_model(),
            "cores": os.cpu_count(),
            "usable": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
            "capability": torch.backends.cpu.get_cpu_capability(),
        },
        "gpu": {
            "names": [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())] if cuda else [],
            "cuda": torch.version.cuda,
            "cudnn": torch.backends.cudnn.version() if cuda else None,
        },
        "threads": {"torch": torch.get_num_threads(), "interop": torch.get_num_interop_threads()},
        "deterministic": torch.are_deterministic_algorithms_enabled(),
        "seed": seed,
        "variables": {name: os.environ[name] for name in VARIABLES if name in os.environ},
        "command": list(sys.argv),
    }


def differences(before: Mapping[str, Any], after: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    """Dotted name -> its two values, where two results of `capture` differ; the command is left out."""
    first, second = flatten(before), flatten(after)
    names = [name for name in dict.fromkeys([*first, *second]) if name != "command"]
    return {name: (first.get(name), second.get(name)) for name in names if first.get(name) != second.get(name)}


def dirty_diff(root: Path | None = None) -> str:
    """The changes since the last commit, as text for `git apply`; empty without changes or without a checkout.

    Changes of tracked files come first, then new source files whole. Other new files are only named, in `#` lines at
    the top; so is a diff beyond `DIFF_LIMIT`.
    """
    root = root or checkout()
    if root is None:
        return ""
    base = (
        "HEAD" if _git(root, "rev-parse", "--verify", "HEAD") else _git(root, "hash-object", "-t", "tree", "/dev/null")
    )
    if not base:
        return ""
    diff = ("diff", "--no-ext-diff", "--no-color")
    parts = [_git(root, *diff, "--no-textconv", base.strip()) or ""]
    notes = []
    for name in (_git(root, "ls-files", "--others", "--exclude-standard", "-z") or "").split("\0"):
        path = root / name
        if not name or not path.is_file() or path.is_symlink():
            continue
        if path.suffix in SOURCES and path.stat().st_size <= DIFF_LIMIT:
            parts.append(_git(root, *diff, "--no-index", "--", os.devnull, name, exit_codes=(0, 1)) or "")
        else:
            notes.append(f"# new file left out: {name!r}, {path.stat().st_size} bytes\n")
    text = "".join(parts)
    return "".join(notes) + (text if len(text) <= DIFF_LIMIT else f"# changes left out: {len(text)} characters\n")


def _git_state(root: Path | None) -> dict[str, Any]:
    commit = _git(root, "rev-parse", "--verify", "HEAD") if root else None
    status = _git(root, "status", "--porcelain") if root else None
    branch = _git(root, "branch", "--show-current") if root else None
    return {
        "commit": commit.strip() if commit else None,
        "branch": branch.strip() or None if branch else None,
        "dirty": None if status is None else bool(status.strip()),
    }


def _git(root: Path, *arguments: str, exit_codes: tuple[int, ...] = (0,)) -> str | None:
    """Output of a git command; None if it ends with another exit code."""
    # Without optional locks a run does not disturb the user's own git commands.
    command = ["git", "--no-optional-locks", "-c", "core.fsmonitor=false", "-c", "core.quotePath=false", *arguments]
    try:
        done = subprocess.run(command, cwd=root, capture_output=True, timeout=20, stdin=subprocess.DEVNULL, check=False)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.decode("utf-8", errors="replace") if done.returncode in exit_codes else None


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def _cpu_model() -> str | None:
    try:
        with open("/proc/cpuinfo", encoding="utf-8", errors="replace") as lines:
            for line in lines:
                if line.startswith("model name"):
                    return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine() or None
