"""What README and docs/ tell a reader to type is understood, what they link to is there, and README's tables are those
of the committed runs."""

import itertools
import re
from collections.abc import Iterator

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override

from qnerf.config.settings import settings_from
from tests.helpers.configs import ROOT, composed, swept

DOCUMENTS = [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").glob("*.md"))]
HEADERS = [*sorted((ROOT / "conf").rglob("*.yaml")), *sorted((ROOT / "sweeps").glob("*.yaml"))]
MEAN = r"\d+\.\d\d ± \d+\.\d\d"
INTERVAL = r"([+-]?\d+\.\d\d) \[([+-]?\d+\.\d\d), ([+-]?\d+\.\d\d)\]"


def commands() -> Iterator[tuple[str, str]]:
    """File and command of each training that a document or the header of a configuration tells."""
    for file in (*DOCUMENTS, *HEADERS):
        text = file.read_text()
        block = r"^(?:    |#   )(python -m src\.run\b[^#\n]*)"
        inline = r"`((?:python -m src\.run\b|-cn )[^`]*)`"
        for command in dict.fromkeys(re.findall(block, text, re.MULTILINE) + re.findall(inline, text)):
            yield str(file.relative_to(ROOT)), " ".join(command.split())


COMMANDS = sorted(set(commands()))


def test_there_are_commands():
    assert len(COMMANDS) > 60


@pytest.mark.parametrize(("file", "command"), COMMANDS)
def test_a_command_is_understood(file, command):
    """Its sweep is there, and with every value of every option that it names it is a valid configuration."""
    words = command.split()
    sweep = words[words.index("-cn") + 1] if "-cn" in words else ""
    if sweep:
        assert swept(sweep)
    overrides = OverridesParser.create().parse_overrides([word for word in words if "=" in word])
    overrides = [override for override in overrides if not override.key_or_group.startswith("hydra")]
    for job in itertools.zip_longest(*map(told, overrides)):
        config = composed(*filter(None, job), sweep=sweep)
        if "auto" not in command:  # which is decided from the scene
            settings_from(config)


def told(override: Override) -> list[str]:
    """`key=value` for each value that a sweep would give it."""
    key, value = override.input_line.split("=", 1)
    return (
        [f"{key}={one}" for one in override.sweep_string_iterator()]
        if override.is_sweep_override()
        else [f"{key}={value}"]
    )


def test_results_that_readme_quotes_are_on_the_page_of_results():
    """Every mean ± deviation and every difference [interval], whichever way round it was taken."""
    page = (ROOT / "docs" / "results.md").read_text()
    readme = (ROOT / "README.md").read_text()
    told = " ".join(
        readme[readme.index("## Results") : readme.index("## Speed against error")].replace("**", "").split()
    )
    means, intervals = set(re.findall(MEAN, told)), set(map(as_numbers, re.findall(INTERVAL, told)))
    assert len(means) > 20
    assert len(intervals) > 60
    assert means <= set(re.findall(MEAN, page))
    known = set(map(as_numbers, re.findall(INTERVAL, page)))
    assert intervals <= known | {(-mean, -high, -low) for mean, low, high in known}


def as_numbers(texts: tuple[str, ...]) -> tuple[float, ...]:
    return tuple(map(float, texts))


@pytest.mark.parametrize("file", DOCUMENTS, ids=lambda file: file.name)
def test_what_a_document_links_to_is_there(file):
    for target in re.findall(r"\]\(([^)#\s]+)", file.read_text()):
        assert "://" in target or (file.parent / target).exists(), target
