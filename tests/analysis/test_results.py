import dataclasses
import itertools
import re
from collections.abc import Iterator
from typing import Any

import pytest
from qnerf.analysis import load
from qnerf.analysis.pack import main as pack
from qnerf.analysis.question import Question
from qnerf.analysis.questions import QUESTIONS
from qnerf.analysis.results import main, page, read_text

from qnerf.model.labels import labels
from tests.helpers.configs import ROOT, composed, swept
from tests.helpers.packed_stores import write_run


@pytest.fixture
def folder(tmp_path):
    for seed in (0, 1):
        for field, psnr in (("classical", 24.0), ("qcolor", 25.0)):
            write_run(tmp_path / "runs", field, seed, [psnr, psnr + 1])
    pack([str(tmp_path / "runs"), str(tmp_path / "results" / "scenes")])
    return tmp_path / "results"


def test_the_page_has_a_section_a_folder(folder):
    (folder / "hardware.txt").write_text("On a machine.\n")
    text = page(folder)
    assert "On a machine." in text
    assert text.count("\n## ") == 1
    assert "## How good is a circuit head on each scene?" in text
    assert "python -m src.run -cd sweeps -cn scenes budget=short" in text
    assert "4 runs; `train=quick`, 10 steps; seeds 0, 1." in text
    assert "| +1.00 ± 0.00 | better" in text


def test_it_is_written_where_one_says(folder, tmp_path):
    main([str(folder), "--write", str(tmp_path / "page.md")])
    assert (tmp_path / "page.md").read_text() == page(folder)


def test_a_folder_without_a_question_is_named(folder):
    (folder / "scenes").rename(folder / "nonsense")
    with pytest.raises(ValueError, match=r"expected folders of packed runs, among scenes, .* got nonsense"):
        page(folder)
    with pytest.raises(ValueError, match="got none"):
        page(folder / "empty")


def test_every_command_of_a_question_names_a_sweep_that_is_there():
    commands = [line.split() for question in QUESTIONS.values() for line in question.commands if "-cn" in line]
    assert {line[line.index("-cn") + 1] for line in commands} <= {
        path.stem for path in (ROOT / "sweeps").glob("*.yaml")
    }


@pytest.mark.skip(reason="the pages of results are being written anew, with verdicts")
def test_the_committed_page_is_made_from_the_committed_runs():
    docs = ROOT / "docs"
    assert page(docs / "results") == (docs / "results.md").read_text()


@pytest.mark.parametrize("name", sorted(QUESTIONS))
def test_a_question_can_be_asked_of_its_sweep(name, tmp_path):
    """The rows tell all that the sweep varies, and the baseline is one of them."""
    question = QUESTIONS[name]
    for number, (columns, config) in enumerate(jobs(question)):
        write_run(tmp_path, columns={"number": number, **columns}, config=config, results={question.metric: 0.5})
    question = dataclasses.replace(question, units=False, hardware=False)  # the sweep does not probe its runs
    titles = [table.title for table in question.tables(load.runs(tmp_path))]
    assert len(titles) == 1 + len(question.other_baselines) + question.failures + len(question.paper)


def jobs(question: Question) -> Iterator[tuple[dict[str, Any], dict[str, Any]]]:
    """Labels and configuration of each job of the question's sweeps, but for the seeds."""
    for command in question.commands:
        words = command.split()
        if "src.run" not in words:
            continue
        sweep = words[words.index("-cn") + 1] if "-cn" in words else ""
        choices = (swept(sweep) if sweep else {}) | dict(
            word.lstrip("+").split("=", 1) for word in words if "=" in word
        )
        choices.pop("seed", None)
        for values in itertools.product(
            *(some(key, re.split(r",(?![^\[]*\])", text), question) for key, text in choices.items())
        ):
            job = (f"{key}={value}" for key, value in zip(choices, values, strict=True))
            config = composed(*job, sweep=sweep)
            yield labels(config), {key: value for key, value in config.items() if key != "seed"}


def some(key: str, values: list[str], question: Question) -> list[str]:
    """Every experiment, which may be anything; of an option two values, which show whether a row tells it."""
    if key == "experiment":
        return values
    base = str((question.baseline or {}).get(key, values[0]))
    return [value for value in values if value in (base, f"{base}.0", *values[:2])]


def test_texts_of_a_folder_from_elsewhere_hold_no_escape_sequences(tmp_path):
    (tmp_path / "hardware.txt").write_text("an \x1b[31mEPYC\r\n\u202etwo cores\n")
    assert read_text(tmp_path / "hardware.txt") == "an \\x1b[31mEPYC\n\\u202etwo cores"
