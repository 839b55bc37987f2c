"""Shared by all tests: composing the real configuration, a tiny scene, the optional data folder."""

import os

os.environ["OMP_WAIT_POLICY"] = os.environ.get("OMP_WAIT_POLICY", "PASSIVE")  # as the command line does: before PyTorch

import signal
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import hypothesis
import pytest
import torch

from tests.helpers.configs import MOMENT, TINY, composed
from tests.helpers.scenes import write_scene

# Examples are the same in every run; how long one takes is nobody's promise.
hypothesis.settings.register_profile("suite", deadline=None, derandomize=True)
# `QNERF_HYPOTHESIS=long python -m pytest tests/numerics`: other examples each time, more than 10^5 over all of them.
hypothesis.settings.register_profile("long", deadline=None, max_examples=2500)
hypothesis.settings.load_profile(os.environ.get("QNERF_HYPOTHESIS", "suite"))

SLOW = (
    "analysis/test_figures.py",
    "analysis/test_figures_of_files.py",
    "analysis/test_notebooks.py",
    "analysis/test_packed.py",
    "analysis/test_report.py",
    "analysis/test_report_browser.py",
    "analysis/test_tables.py",
    "auto/test_exposure.py",
    "auto/test_poses.py",
    "auto/test_resolve.py",
    "auto/test_rules.py",
    "auto/test_runs.py",
    "capture/",
    "cli/commands/test_reproduce.py",
    "cli/commands/test_resume.py",
    "cli/test_cluster.py",
    "cli/test_compose.py::test_a_wrong_command_is_one_line_with_exit_code_2",
    "cli/test_launch.py",
    "cli/test_python.py",
    "cli/test_search.py",
    "config/test_acting.py::test_a_random_value_is_taken_or_refused_in_one_line",
    "config/test_conf.py",
    "config/test_plugins.py",
    "docs/test_results.py",
    "faults/",
    "kernels/test_jit.py",
    "model/test_counts.py",
    "numerics/test_bounds.py::test_hard_cases",
    "numerics/test_circuits_cases.py",
    "numerics/test_determinism.py",
    "numerics/test_losses_cases.py",
    "probes/",
    "records/test_index.py::test_store_that_changes",
    "scenes/test_fingerprint.py",
    "signals/test_runs.py",
    "quantum/test_engines.py::test_engines_agree",
    "quantum/test_tapes.py::test_random",
    "quantum/test_tapes.py::test_device_passes",
    "search/",
    "test_devices.py",
    "test_documents.py::test_commands_are_understood",
    "test_experiment.py",
    "training/test_trainer.py",
    "viewing/",
)
"""Beginnings of the ids, below tests/, of tests that take seconds, setup included, or that are many and train."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if item.nodeid.removeprefix("tests/").startswith(SLOW):
            item.add_marker(pytest.mark.slow)


@pytest.fixture
def signals() -> Iterator[None]:
    """SIGINT and SIGHUP act as in a terminal, also where the tests were started with `nohup` or in the background."""
    usual = {"SIGINT": signal.default_int_handler, "SIGHUP": signal.SIG_DFL}
    kinds = {getattr(signal, name): action for name, action in usual.items() if hasattr(signal, name)}
    ignored = [kind for kind in kinds if signal.getsignal(kind) is signal.SIG_IGN]
    for kind in ignored:
        signal.signal(kind, kinds[kind])
    yield
    for kind in ignored:
        signal.signal(kind, signal.SIG_IGN)


@pytest.fixture
def config() -> Callable[..., dict[str, Any]]:
    return composed


@pytest.fixture
def tiny_scene(tmp_path: Path) -> Path:
    return write_scene(tmp_path / "scene")


@pytest.fixture
def tiny(tiny_scene: Path, tmp_path: Path) -> Callable[..., dict[str, Any]]:
    """A configuration that trains in a moment: `tiny("field=qboth")`."""

    def make(*overrides: str, sampler: Sequence[str] = TINY) -> dict[str, Any]:
        chosen = [item.split("=")[0] for item in overrides]
        scene = [] if "scene" in chosen else ["scene=nerfstudio", f"scene.path={tiny_scene}"]
        small = () if "sampler" in chosen else sampler
        return composed(*scene, *small, *MOMENT, f"store={tmp_path / 'runs'}", *overrides)

    return make


@pytest.fixture(autouse=True)
def _threads_and_seed() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(min(2, before))
    torch.manual_seed(0)
    yield
    torch.set_num_threads(before)
