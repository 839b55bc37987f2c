"""What sdist and wheel hold, and that the wheel works far from the checkout, which nothing else in the tests shows."""

import os
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

from tests.helpers.configs import ROOT

pytest.importorskip("setuptools", minversion="77")

IN_WHEEL = {"src/qnerf": "", "conf": "conf", "sweeps": "sweeps", "analysis": "analysis"}
"""Folder of a checkout -> its folder in the installed package."""
NOT_IN_SDIST = {".gitignore", ".github"}


def build(kind: str, source: Path, target: Path) -> Path:
    """Builds an sdist or a wheel with this environment's setuptools, so without network."""
    code = f"from setuptools import build_meta; print(build_meta.build_{kind}({str(target)!r}))"
    done = subprocess.run([sys.executable, "-c", code], cwd=source, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return target / done.stdout.splitlines()[-1]


def tracked() -> set[str]:
    """The repository's files; without git, such as in an unpacked sdist, what looks like them."""
    listed = subprocess.run(
        ["git", "ls-files", "-co", "--exclude-standard"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    if listed.returncode == 0:
        return {name for name in listed.stdout.splitlines() if (ROOT / name).is_file()}
    folders = ("src", "conf", "sweeps", "analysis", "benchmarks", "tests", "docs", ".ci")
    files = [path for folder in folders for path in (ROOT / folder).rglob("*") if path.is_file()]
    files = [path for path in files if "__pycache__" not in path.parts and ".egg-info" not in str(path)]
    files += [path for path in ROOT.iterdir() if path.is_file() and path.name not in ("PKG-INFO", "setup.cfg")]
    return {path.relative_to(ROOT).as_posix() for path in files}


@pytest.fixture(scope="module")
def sdist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("source")
    for name in tracked():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / name, folder / name)
    return build("sdist", folder, tmp_path_factory.mktemp("sdist"))


@pytest.fixture(scope="module")
def wheel(sdist: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built from the sdist alone."""
    folder = tmp_path_factory.mktemp("unpacked")
    with tarfile.open(sdist) as archive:
        archive.extractall(folder, filter="data")
    (source,) = folder.iterdir()
    return build("wheel", source, tmp_path_factory.mktemp("wheel"))


def test_the_sdist_holds_the_repository(sdist: Path) -> None:
    with tarfile.open(sdist) as archive:
        held = {name.partition("/")[2] for name in archive.getnames()}
    assert {name for name in tracked() if name.split("/")[0] not in NOT_IN_SDIST} <= held
    assert not [name for name in held if "__pycache__" in name]


def test_the_wheel_holds_every_file_of_every_folder(wheel: Path) -> None:
    expected: set[str] = set()
    for folder, inside in IN_WHEEL.items():
        names = {name.removeprefix(f"{folder}/") for name in tracked() if name.startswith(f"{folder}/")}
        expected |= {"/".join(filter(None, ["qnerf", inside, name])) for name in names}
    held = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    assert held == expected
    suffixes = {Path(name).suffix for name in held}
    assert {".py", ".typed", ".yaml", ".js", ".css", ".html", ".ipynb"} <= suffixes


def test_an_unpacked_wheel_composes_a_configuration(wheel: Path, tmp_path: Path) -> None:
    """In an empty folder. .ci/run trains with an installed wheel; here that would compile every kernel anew."""
    zipfile.ZipFile(wheel).extractall(tmp_path / "packages")
    (tmp_path / "work").mkdir()
    (tmp_path / "work" / "mine.yaml").write_text("defaults: [config, _self_]\nseed: 7\n")
    code = (
        "import qnerf.analysis.load as load; from qnerf.cli.main import main; print(load.__file__, flush=True); main()"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, "run", "--sweep", "mine.yaml", "field=qboth", "--cfg", "job"],
        cwd=tmp_path / "work", env={**os.environ, "PYTHONPATH": str(tmp_path / "packages")},
        capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(str(tmp_path / "packages"))
    assert "seed: 7" in done.stdout
