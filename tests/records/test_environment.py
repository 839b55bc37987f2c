import json
import subprocess

import pytest
import torch

from qnerf.records import environment


def git(root, *arguments):
    somebody = ["-c", "user.name=t", "-c", "user.email=t@example.org", "-c", "init.defaultBranch=main"]
    subprocess.run(["git", *somebody, *arguments], cwd=root, check=True, capture_output=True)


@pytest.fixture
def repository(tmp_path):
    root = tmp_path / "repository"
    root.mkdir()
    git(root, "init")
    (root / "code.py").write_text("a = 1\n")
    git(root, "add", ".")
    git(root, "commit", "-m", "first")
    return root


def test_capture_is_plain_and_complete():
    seen = environment.capture(seed=7)
    assert json.loads(json.dumps(seen)) == seen
    assert seen["seed"] == 7
    assert seen["threads"]["torch"] == torch.get_num_threads()
    assert seen["packages"]["torch"].split("+")[0] == torch.__version__.split("+")[0]  # some builds add "+cu124"
    assert seen["packages"]["qnerf"]
    assert seen["cpu"]["model"]
    assert seen["cpu"]["usable"] >= 1


def test_environment_records_the_state_of_git(repository):
    clean = environment.capture(root=repository)["git"]
    assert clean["branch"] == "main"
    assert len(clean["commit"]) == 40
    assert clean["dirty"] is False
    (repository / "code.py").write_text("a = 2\n")
    assert environment.capture(root=repository)["git"] == clean | {"dirty": True}


def test_environment_outside_of_a_checkout(tmp_path):
    assert environment.capture(root=tmp_path)["git"] == {"commit": None, "branch": None, "dirty": None}
    assert environment.dirty_diff(tmp_path) == ""


def test_diff_makes_the_checkout_again(repository, tmp_path):
    assert environment.dirty_diff(repository) == ""
    (repository / "code.py").write_text("a = 2\n")
    (repository / "nëw file.py").write_text("b = 3\n")
    (repository / "data.bin").write_bytes(b"\0" * 100)
    diff = environment.dirty_diff(repository)
    assert "# new file left out: 'data.bin', 100 bytes" in diff
    other = tmp_path / "other"
    git(tmp_path, "clone", str(repository), str(other))
    (tmp_path / "dirty.diff").write_text(diff)
    git(other, "apply", str(tmp_path / "dirty.diff"))
    assert (other / "code.py").read_text() == "a = 2\n"
    assert (other / "nëw file.py").read_text() == "b = 3\n"


def test_large_changes_are_named_not_saved(repository, monkeypatch):
    monkeypatch.setattr(environment, "DIFF_LIMIT", 50)
    (repository / "code.py").write_text("a = 1\n" * 50)
    diff = environment.dirty_diff(repository)
    assert diff.startswith("# changes left out: ")
    assert len(diff.splitlines()) == 1
