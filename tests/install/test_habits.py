"""The files around the code agree with each other and with it."""

import re
import subprocess
import tomllib

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from qnerf import __version__
from tests.helpers.configs import ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def test_the_citation_is_of_this_version():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["version"] == __version__
    assert {"cff-version", "title", "message", "authors", "license"} <= set(citation)


def test_every_extra_that_a_message_names_exists():
    for file in [*(ROOT / "src").rglob("*.py"), *(ROOT / "docs").glob("*.md"), ROOT / "README.md"]:
        for extras in re.findall(r"qnerf\[([a-z0-9,]+)\]", file.read_text()):
            assert set(extras.split(",")) <= set(PROJECT["optional-dependencies"]), file


def test_the_hooks_before_a_commit_are_tools_of_the_dev_extra():
    (repository,) = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"]
    tools = {re.match(r"[a-z-]+", requirement)[0] for requirement in PROJECT["optional-dependencies"]["dev"]}
    assert {hook["entry"].split()[0] for hook in repository["hooks"]} <= tools


def test_the_workflow_does_what_ci_run_does():
    workflow = ROOT / ".github" / "workflows" / "ci.yml"
    if not workflow.is_file():
        pytest.skip("a source distribution has no workflow")
    steps = yaml.safe_load(workflow.read_text())["jobs"]["test"]["steps"]
    assert [step["run"] for step in steps if "run" in step] == [".ci/run"]


def test_ci_run_reads_its_commands_from_readme():
    script, readme = (ROOT / ".ci" / "run").read_text(), (ROOT / "README.md").read_text()
    marks = re.findall(r"\$\(command_after (\w+)\)", script)
    assert marks == ["install", "test"]
    for mark in marks:
        assert f"<!-- {mark} -->\n```" in readme


def test_the_scripts_are_bash():
    for script in ("run", "versions"):
        assert subprocess.run(["bash", "-n", ROOT / ".ci" / script], check=False).returncode == 0


PATCHED = ("hydra-core", "numba", "viser")
"""Packages whose private parts we use: plugins and composition; how types are chosen; how the server is started."""


def test_dependencies_have_lowest_versions_and_patched_ones_highest():
    """`.ci/versions lowest` installs the bound itself; constraints.txt holds a set that the bounds admit."""
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    tried = dict(line.split("==") for line in lines if not line.startswith("#"))
    extras = PROJECT["optional-dependencies"]
    wanted = [*PROJECT["dependencies"], *(line for extra in extras.keys() - {"dev"} for line in extras[extra])]
    for line in wanted:
        if not line.startswith("qnerf["):
            requirement = Requirement(line)
            bounds = {bound.operator for bound in requirement.specifier}
            assert bounds == ({">=", "<"} if requirement.name in PATCHED else {">="}), line
            version = tried.get(canonicalize_name(requirement.name))
            assert version in requirement.specifier if version else line not in PROJECT["dependencies"], line
