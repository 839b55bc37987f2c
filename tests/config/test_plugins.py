"""`plugins=[my_module]`: the examples of docs/extending.md, trained as a user would."""

import os
import re
import subprocess
import sys

import pandas as pd
import pytest

from qnerf import records
from qnerf.cli.compose import plugins as typed_plugins
from qnerf.cli.plugins import node
from qnerf.config.plugins import check_plugins
from qnerf.config.registry import Registry
from tests.helpers.configs import ROOT, TINY, composed
from tests.helpers.processes import call

MODULES = ("my_circuit.py", "my_module.py", "my_signal.py")  # as the page names its blocks of code
PAGE = (ROOT / "docs" / "extending.md").read_text()
SMALL = (
    "plugins=[my_module]", "scene=poster", "scene.views=6",
    "train.steps=2", "train.rays=8", "train.eval_every=0", "visibility.resolution=16", "device=cpu", "threads=1",
    "run.progress=false", *TINY,
)  # fmt: skip
TABLE = ("--metric", "largest_error", "--values", "largest_error")
RUN = "from qnerf.cli.main import run; run()"


@pytest.fixture
def folder(tmp_path):
    """With the page's modules in it, and nothing else."""
    for name, module in zip(MODULES, re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL), strict=True):
        (tmp_path / name).write_text(module)
    return tmp_path


def typed_on_the_page(module):
    (command,) = re.findall(rf"^    python -m src\.run (plugins=\[{module}\].*)", PAGE, re.MULTILINE)
    return command.split()


def qnerf(folder, *arguments):
    """A command in the folder, in a process of its own."""
    return call(*arguments, cwd=folder)


def test_the_page_s_components_train_side_by_side_and_are_not_imported_unasked(folder):
    swept = subprocess.run(
        [sys.executable, "-c", RUN, "-m", *typed_on_the_page("my_module"), *SMALL, "hydra/launcher=submitit_local",
         "seed=0,1"],
        cwd=folder,
        env=os.environ | {"OMP_NUM_THREADS": "1", "PYTHONSAFEPATH": "1"},
        capture_output=True,
        text=True,
        timeout=300,
    )  # fmt: skip
    assert swept.returncode == 0, swept.stderr + swept.stdout
    _, run = records.runs(folder / "runs")
    summary = records.read_summary(run)
    assert (summary["encoder"], summary["encoder.bands"]) == ("triangle", 6)
    assert (summary["color"], summary["color.sine.width"], summary["field"]) == ("sine", 64, "classical")
    again = qnerf(folder, "reproduce", str(run), "plugins=[my_module]")
    assert "bit for bit" in again.stdout, again.stdout + again.stderr
    (folder / "my_module.py").write_text("raise SystemExit('imported')\n")
    for words in (["resume", str(run)], ["reproduce", str(run)], ["probe", str(run), "units"]):
        status = run / "status.json"
        finished = status.read_text()
        if words[0] == "resume":
            status.write_text(finished.replace('"finished"', '"interrupted"'))
        refused = qnerf(folder, *words)
        status.write_text(finished)
        assert refused.returncode == 2
        assert re.fullmatch(r"error: .*repeat plugins=\[my_module\] on the command line.*\n", refused.stderr)


def test_the_page_s_qnode_is_a_head_whose_options_name_its_run_and_which_is_probed(folder):
    small = (one for one in SMALL if not one.startswith("plugins="))
    head = ("plugins=[my_circuit]", "color=mine", "color.mine.layers=1", "color.mine.wires=3")
    trained = qnerf(folder, "run", *head, *small)
    assert trained.returncode == 0, trained.stderr
    (run,) = records.runs(folder / "runs")
    summary = records.read_summary(run)
    assert (summary["color"], summary["field"]) == ("mine-wires3-layers1", "qcolor")
    assert (summary["color.mine.layers"], summary["color.mine.gain"]) == (1, 10)
    assert "-mine-wires3-layers1-s0-" in run.name
    probed = qnerf(folder, "probe", str(run), "cost", "plugins=[my_circuit]")
    assert probed.returncode == 0, probed.stderr
    assert pd.read_parquet(run / "cost.parquet")["wires"].tolist() == [3]


def test_a_module_that_is_not_there_is_one_line(folder):
    missing = qnerf(folder, "run", "plugins=[nowhere]")
    assert (missing.returncode, missing.stderr.count("\n")) == (2, 1)
    assert "plugins: no module 'nowhere'; expected nowhere.py in the current folder" in missing.stderr
    (folder / "broken.py").write_text("import nothing_of_that_name\n")
    missing = qnerf(folder, "run", "plugins=[broken]")
    assert "plugins: broken imports nothing_of_that_name, which is not installed here" in missing.stderr


def test_the_page_s_signal_trains_resumes_and_is_shown(folder):
    small = ("train.steps=4", "train.eval_every=2", "device=cpu", "threads=1", "run.progress=false")
    trained = qnerf(folder, "run", *typed_on_the_page("my_signal"), *small)
    assert trained.returncode == 0, trained.stderr
    assert re.search(r"step 2: largest error \d", trained.stdout)
    (run,) = records.runs(folder / "runs")
    config = records.read_config(run)
    assert config["scene"] == {"name": "wave", "periods": 3, "samples": 64}
    assert (config["encoder"]["name"], config["train"]["name"], config["head"]["name"]) == ("signed", "fit", "siren")
    finished = records.read_summary(run)
    status = run / "status.json"
    status.write_text(status.read_text().replace('"finished"', '"interrupted"'))
    resumed = qnerf(folder, "resume", str(run), "plugins=[my_signal]")
    assert resumed.returncode == 0, resumed.stderr
    assert records.read_summary(run)["largest_error"] == finished["largest_error"]
    again = qnerf(folder, "reproduce", str(run), "plugins=[my_signal]")
    assert "bit for bit" in again.stdout, again.stdout + again.stderr
    for words in (["runs", "--columns", "largest_error"], ["tables", "runs", *TABLE], ["show", str(run)]):
        shown = qnerf(folder, *words)
        assert shown.returncode == 0, shown.stderr
        assert words[0] not in ("runs", "tables") or f"{finished['largest_error']:.3g}" in shown.stdout


def test_a_signal_s_metrics_are_declared(folder):
    module = (folder / "my_signal.py").read_text()
    (folder / "my_signal.py").write_text(module.replace('declare(Metric("largest_error"', 'declare(Metric("other"'))
    failed = qnerf(folder, "run", *typed_on_the_page("my_signal"), "train.steps=2", "run.progress=false")
    assert failed.returncode == 2
    assert re.fullmatch(r"error: Wave: metric '\w+est_error' must be one that .*; known: psnr.*\n", failed.stderr)


def test_only_the_modules_that_the_user_names_are_imported():
    for stored in (["a", "b"], "a", 3, {"a": 1}, None):
        with pytest.raises(ValueError, match=r"^run: was trained with plugins="):
            check_plugins("run", stored, [])
        check_plugins("run", [], [])
        check_plugins("run", ["a", "b"], ["b", "a"])


def test_plugins_are_a_list_of_names():
    for typed in ("plugins=a", "plugins=[1]", "+plugins={a: 1}", "plugins=[a],[b]"):
        with pytest.raises(ValueError, match=r"expected a list of modules, such as plugins=\[my_module\]"):
            typed_plugins([typed])
        assert typed_plugins(["seed=1", "plugins=[a,b.c]"]) == ["a", "b.c"]


def test_the_node_of_a_signature_is_what_conf_has():
    """For components of the package, so that a plugin's node can be trusted."""
    for group, name, key, part in (
        ("encoder", "pe", "encoder", "encoder"),
        ("head", "mlp", "head@density", "density"),
        ("head", "qfgn", "head@color", "color"),
        ("ansatz", "qiren", "ansatz", "qiren"),
        ("cameras", "se3", "cameras", "cameras"),
    ):
        made, config = node(group, name), composed(f"{key}={name}", "train=paper")[part]
        assert made.pop("defaults", ["_base"]) == ["_base"]
        assert made == {option: config[option] for option in made}
        assert group in ("head", "ansatz") or made == config


def test_an_option_without_a_default_has_to_be_given(monkeypatch):
    registry = Registry("encoder")

    @registry.register("needy")
    class Needy:
        def __init__(self, in_dim: int, *, size: int, shape: tuple[int, ...] = (1, 2)) -> None: ...

    monkeypatch.setattr("qnerf.cli.plugins.groups", lambda: {"encoder": registry})
    assert node("encoder", "needy") == {"name": "needy", "size": "???", "shape": [1, 2]}


@pytest.mark.parametrize(
    ("raising", "told"),
    [
        ("{}['missing']", r"my_module\.SineHead\.forward, line \d+: KeyError: 'missing'"),
        ("raise ValueError('not today')", r"my_module\.SineHead\.forward, line \d+: not today"),
    ],
)
def test_an_error_in_a_module_is_one_line_that_names_it(folder, raising, told):
    file = folder / "my_module.py"
    file.write_text(file.read_text().replace("return self.readout", f"{raising}\n        return self.readout"))
    failed = qnerf(folder, "run", "plugins=[my_module]", "scene=photograph", "head=sine", "run.progress=false")
    assert failed.returncode == 1
    assert re.fullmatch(rf"error: {told}\n", failed.stderr)
