"""`qnerf run` in this process, as a user calls it."""

import json
import sys
from dataclasses import dataclass

import pytest
from hydra.core.global_hydra import GlobalHydra

from qnerf.cli import launch, main, sweep
from tests.helpers.configs import MOMENT, TINY


@dataclass
class Done:
    code: int
    out: str
    err: str

    @property
    def json(self):
        return json.loads(self.out)


@pytest.fixture
def qnerf(monkeypatch, capsys, tmp_path):
    """`qnerf("run", "seed=1")`: exit code, output and standard error of a command, in an empty folder."""

    def call(*arguments, full_error=False):
        monkeypatch.setenv("HYDRA_FULL_ERROR", str(int(full_error)))
        monkeypatch.setattr(sys, "argv", ["qnerf", *arguments])
        monkeypatch.setattr(sweep, "started", [])
        monkeypatch.setattr(launch, "_jobs", [])
        monkeypatch.setattr(launch, "_full_errors", [])
        GlobalHydra.instance().clear()
        capsys.readouterr()
        code = 0
        try:
            main.main()
        except SystemExit as end:
            code = int(end.code or 0)
        return Done(code, *capsys.readouterr())

    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    # Hydra would disable the loggers of all tests.
    monkeypatch.setattr("hydra._internal.logging_config.configure_logging", lambda *_: None)
    yield call
    GlobalHydra.instance().clear()


@pytest.fixture
def small(tiny_scene, tmp_path):
    """A training of a moment in the store tmp_path/runs."""
    scene = ("scene=nerfstudio", f"scene.path={tiny_scene}", f"store={tmp_path / 'runs'}")
    return [*TINY, *MOMENT, *scene, "field=classical"]
