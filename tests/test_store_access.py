"""Paths of a store are opened, listed and changed through `records/files.py` alone."""

import ast
from collections.abc import Iterator

import pytest

from tests.helpers.configs import ROOT

ROOMS = ("src/qnerf/records", "src/qnerf/cli", "src/qnerf/export", "analysis")
METHODS = {"open", "scandir", "listdir", "walk", "iterdir", "glob", "rglob", "read_text", "read_bytes", "write_text",
           "write_bytes", "mkdir", "makedirs", "touch", "unlink", "rmdir", "rmtree", "symlink_to", "hardlink_to",
           "copytree", "copyfile", "copy2", "read_parquet", "memory_map"}  # fmt: skip
OF_OS = {"rename", "replace", "remove", "link", "symlink"}  # texts and tables have methods of these names

ALLOWED = {
    "src/qnerf/records/files.py": "the functions themselves",
    "src/qnerf/records/store.py": "makes the store's root",
    "src/qnerf/records/environment.py": "reads /proc and the checkout of qnerf",
    "src/qnerf/records/owner.py": "reads /proc",
    "src/qnerf/records/pictures.py": "decodes a picture that `files` has opened",
    "src/qnerf/records/index/index_file.py": "makes the user's cache folder",
    "src/qnerf/records/index/remote.py": "copies a remote run's metrics to a temporary folder",
    "src/qnerf/cli/ends.py": "opens the null device and the standard streams",
    "src/qnerf/cli/errors.py": "opens the null device",
    "src/qnerf/cli/overrides.py": "lists the choices in conf/",
    "src/qnerf/cli/commands/show.py": "lists the files of a run",
    "src/qnerf/cli/search.py": "the folder of a sweep, where its jobs find what judges them",
    "src/qnerf/cli/commands/completion.py": "lists the files in sweeps/",
    "src/qnerf/cli/sweep.py": "the folder of a sweep, where its jobs report",
    "src/qnerf/export/content.py": "the user's output folder",
    "src/qnerf/export/to_tensorboard.py": "the user's output folder",
    "analysis/output.py": "the user's output folder",
    "analysis/pack.py": "the user's output folder",
    "analysis/packed.py": "a packed folder, which is no store",
    "analysis/results.py": "a packed folder and the user's output file",
    "analysis/figures/files.py": "the user's output folder",
    "analysis/figures/benchmarks.py": "a table of the benchmarks",
    "analysis/report/__main__.py": "the user's output file",
    "analysis/report/figures.py": "figures that were just drawn",
    "analysis/report/page.py": "the page's own scripts and styles",
}
"""File -> what it opens that is not in a store."""


def direct_calls(source: str) -> Iterator[str]:
    """Calls that open, list or change a path without `files`."""
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, ast.Call):
            continue
        called = node.func
        if isinstance(called, ast.Name) and called.id == "open":
            yield "open"
        elif isinstance(called, ast.Attribute):
            base = called.value.id if isinstance(called.value, ast.Name) else ""
            if (called.attr in METHODS and base != "files") or (called.attr in OF_OS and base == "os"):
                yield ast.unparse(called)


FILES = sorted(path for room in ROOMS for path in (ROOT / room).rglob("*.py"))


@pytest.mark.parametrize("file", [path.relative_to(ROOT).as_posix() for path in FILES])
def test_files_of_a_store_are_reached_through_one_module(file: str) -> None:
    calls = list(direct_calls((ROOT / file).read_text()))
    if file not in ALLOWED:
        assert not calls, f"use qnerf.records.files, or say in ALLOWED what is opened: {calls}"


def test_the_search_sees_every_kind_of_call() -> None:
    source = "open(a); path.read_text(); os.replace(a, b); Image.open(a); files.replace(a, b); text.replace(a, b)"
    assert list(direct_calls(source)) == ["open", "path.read_text", "os.replace", "Image.open"]
