"""The pages of results: made from packed runs, a page a question and a line a question in the index."""

import pytest
from qnerf.analysis.pack import main as pack

from docs.tools.results import main, pages, questions
from tests.helpers.configs import ROOT
from tests.helpers.packed_stores import write_run

QUESTION = """\
scenes:
  title: How good is a circuit head on each scene?
  commands: [python -m src.run --sweep scenes budget=short]
  rows: [scene_name, field]
  baseline: {field: classical}
"""


@pytest.fixture
def folder(tmp_path):
    for seed in range(4):
        for field, psnr in (("classical", 24.0), ("qcolor", 25.0)):
            write_run(tmp_path / "runs", field, seed, [psnr + 0.1 * seed, psnr + 1])
    pack([str(tmp_path / "runs"), str(tmp_path / "results" / "scenes")])
    (tmp_path / "results" / "questions.yaml").write_text(QUESTION)
    return tmp_path / "results"


def test_pages_say_what_was_trained_and_the_verdict(folder):
    (folder / "hardware.txt").write_text("On a \x1b[31mmachine.\n")
    main([str(folder)])
    page, index = (folder / "scenes" / "README.md").read_text(), folder.with_suffix(".md").read_text()
    assert {folder / "scenes" / "README.md": page, folder.with_suffix(".md"): index} == pages(folder)
    assert page.startswith(
        "# How good is a circuit head on each scene?\n\n8 runs; `train=quick`, 10 steps; seeds 0 to 3."
    )
    assert "    python -m src.run --sweep scenes budget=short\n" in page
    (row,) = (line for line in page.splitlines() if line.startswith("| qcolor |"))
    assert "| **25.58 ± 0.06** |" in row
    assert "| +1.00 ± 0.11 better * |" in row
    assert "On a \\x1b[31mmachine." in index
    (line,) = (line for line in index.splitlines() if "scenes/README.md" in line)
    assert line.endswith("| table, earlier rate | against classical: qcolor: better |")
    assert "without a registered study" in page


def test_a_folder_without_a_question_is_named(folder):
    (folder / "scenes").rename(folder / "nonsense")
    with pytest.raises(ValueError, match=r"expected folders of packed runs, among scenes; got nonsense"):
        pages(folder)
    (folder / "nonsense").rename(folder.parent / "nonsense")
    with pytest.raises(ValueError, match="got none"):
        pages(folder)


def test_questions_that_cannot_be_read_are_named(folder):
    (folder / "questions.yaml").write_text(QUESTION.replace("rows", "rwos"))
    with pytest.raises(ValueError, match=r"questions.yaml: .*rwos"):
        pages(folder)
    with pytest.raises(ValueError, match="there is no such file"):
        pages(folder / "empty")


def test_the_committed_pages_are_made_from_the_committed_runs():
    folder = ROOT / "docs" / "results"
    assert {path.parent.name for path in folder.glob("*/runs.parquet")} == set(questions(folder))
    for file, text in pages(folder).items():
        assert file.read_text() == text, file
