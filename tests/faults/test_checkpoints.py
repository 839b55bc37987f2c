"""Checkpoints in which anything may have changed; QNERF_FAULTS=full changes every leaf."""

import json
import os
import subprocess
from pathlib import Path

from tests.helpers.configs import TINY, composed
from tests.helpers.processes import start
from tests.helpers.scenes import write_scene

FULL = os.environ.get("QNERF_FAULTS") == "full"
HARMLESS = (": huge", "optimiser: one more", "bit flipped", "step_seconds: ", "plateau.", "param_groups.")
"""Changes with which a checkpoint can still fit: finite values, another step time or best PSNR, unused entries."""


def test_a_changed_checkpoint_is_never_loaded_in_part(tmp_path: Path) -> None:
    """The one before is used, with one line. Nothing crashes, and what is loaded trains on."""
    options = ["field=qcolor", "qiren=1L1S", "hash=C7", "cameras=so3xr3", "appearance=2", "occupancy.every=2"]
    budget = ["train.steps=30", "train.rays=8", "device=cpu", "stop.every=2"]
    scene = ["scene=nerfstudio", f"scene.path={write_scene(tmp_path / 'scene')}"]
    (tmp_path / "config.json").write_text(json.dumps(composed(*TINY, *scene, *options, *budget)))
    (tmp_path / "run").mkdir()
    process = start(
        "foreign_checkpoints", str(tmp_path / "run"), str(tmp_path / "config.json"), "full" if FULL else "short",
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip
    out, err = process.communicate(timeout=1800)
    lines = [json.loads(line) for line in out.splitlines()]
    assert process.returncode == 0, (lines[-1], err[-2000:])
    results = [line for line in lines if "file" in line]
    assert len(results) > (3000 if FULL else 100)
    for line in results:
        assert all("\n" not in message for message in line["messages"])
        if line["file"] == "both":
            assert line["outcome"] == "refused"
            assert "run.force=true does it over" in line["messages"][0]
            assert line["files"] == ["checkpoint.prev.pt", "checkpoint.pt"]
        elif line["outcome"] == "previous":
            (message,) = line["messages"]
            assert message.endswith("going on from the checkpoint before")
        else:
            assert any(part in line["file"] for part in HARMLESS), line
    both, harmless = (
        sum(match in line["file"] for line in results for match in matches) for matches in (["both"], HARMLESS)
    )
    previous = sum(line["outcome"] == "previous" for line in results)
    assert previous >= len(results) - both - harmless > len(results) / 2
    print(f"{len(results)} files, {previous} times the checkpoint before")
