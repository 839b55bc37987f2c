import pytest
from conftest import ROOT
from stores import write_run

from analysis.pack import main as pack
from analysis.results import QUESTIONS, main, page


@pytest.fixture
def folder(tmp_path):
    for seed in (0, 1):
        for field, psnr in (("classical", 24.0), ("qcolor", 25.0)):
            write_run(tmp_path / "runs", field, seed, [psnr, psnr + 1])
    pack([str(tmp_path / "runs"), str(tmp_path / "results" / "scenes")])
    return tmp_path / "results"


def test_the_page_has_a_section_a_folder(folder):
    text = page(folder, "On a machine.")
    assert "On a machine." in text
    assert text.count("\n## ") == 1
    assert "## What does a circuit head give on each scene?" in text
    assert "python -m src.run -cd sweeps -cn scenes budget=short" in text
    assert "4 runs; `train=quick`, 10 steps; seeds 0, 1." in text
    assert "+1.00 [+1.00, +1.00]" in text


def test_it_is_written_where_one_says(folder, tmp_path):
    main([str(folder), "--write", str(tmp_path / "page.md")])
    assert (tmp_path / "page.md").read_text() == page(folder, "")


def test_a_folder_without_a_question_is_named(folder):
    (folder / "scenes").rename(folder / "nonsense")
    with pytest.raises(ValueError, match=r"expected folders of packed runs, among scenes, .* got nonsense"):
        page(folder, "")
    with pytest.raises(ValueError, match="got none"):
        page(folder / "empty", "")


def test_every_command_of_a_question_names_a_sweep_that_is_there():
    commands = [line.split() for question in QUESTIONS.values() for line in question.commands if "-cn" in line]
    assert {line[line.index("-cn") + 1] for line in commands} <= {
        path.stem for path in (ROOT / "sweeps").glob("*.yaml")
    }


def test_the_committed_page_is_made_from_the_committed_runs():
    results = ROOT / "docs" / "results"
    text = (ROOT / "docs" / "results.md").read_text()
    hardware = text.split("that a section names.", 1)[1].split("\n\n", 1)[0].strip()
    assert page(results, hardware) == text
