"""The commands that documents and headers of configurations show, and whether the real parsers take them."""

import argparse
import importlib.util
import re
import runpy
import shlex
import sys
import tomllib
import warnings
from itertools import takewhile
from pathlib import Path

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser

from qnerf.cli import main as cli
from tests.helpers.configs import ROOT, SWEEPS, worked_out

START = r"(?:python3? -m (?:src\.run|qnerf|benchmarks|docs|tests|pytest)\b|qnerf [a-z]+(?=\s|$)|pip install )"
SETTINGS = r"(?:[A-Z_]+=\S+ )*"


class Parsed(Exception):
    """The arguments were understood; nothing else is to happen."""


def shown(file):
    """Each command of a Markdown or YAML file: lines of code blocks, `code` in a sentence, lines of comments."""
    text = file.read_text().replace("\\\n", " ")
    if file.suffix == ".yaml":
        lines = re.findall(r"^# {3,}(\S.*)", text, re.MULTILINE) + re.findall(r'(pip install "[^"]+")', text)
    else:
        fenced = re.findall(r"^```(?:bash|sh)?\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
        inline = re.findall(r"(?<!`)`([^`]+)`(?!`)", re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE))
        lines = [line for block in fenced for line in block.splitlines()]
        lines += re.findall(r"^ {4,}(\S.*)", text, re.MULTILINE) + [" ".join(one.split()) for one in inline]
    for line in lines:
        for part in line.split("&&"):
            if re.match(SETTINGS + START, part.strip()):
                yield re.sub(rf"^{SETTINGS}(?={START})", "", part.strip())


def check(command):
    """Raises an exception, or ends like argparse, where a command is not one that its parser takes."""
    words = list(takewhile(lambda word: word != ">", shlex.split(command, comments=True)))
    if words[0] == "pip":
        check_extras(words[2:])
    elif words[:2] == ["qnerf", "run"]:
        check_training(words[2:])
    elif words[0] == "qnerf":
        parse(cli.main, ["qnerf", *words[1:]])
    elif words[2] == "src.run":
        check_training(words[3:])
    elif words[2] == "pytest":
        missing = [word for word in words[3:] if "/" in word and not (ROOT / word).exists()]
        assert not missing, f"no {missing}"
    else:
        check_module(words[2], words[3:])


def check_extras(words):
    known = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    for extras in re.findall(r"(?:qnerf|\.)\[(.*?)\]", " ".join(words)):
        assert set(extras.split(",")) <= set(known), f"{extras}: known: {', '.join(known)}"


CHECKED = set()
"""The overrides that were in a configuration which was found valid."""


def check_training(words):
    """Its sweep is there, and the overrides that no command before it had are valid in its configuration.

    That the jobs of a sweep are valid is in tests/config/test_conf.py.
    """
    flags = [words[words.index(flag) + 1] for flag in ("-cn", "--sweep") if flag in words]
    sweep = flags[0] if flags and flags[0] != "NAME" else ""
    assert not sweep or (SWEEPS / f"{sweep}.yaml").is_file(), f"no sweep {sweep}"
    overrides = OverridesParser.create().parse_overrides([word for word in words if "=" in word])
    several = [each_value(override) for override in overrides if not override.key_or_group.startswith("hydra")]
    for number in range(max(map(len, several), default=1)):
        job = [values[min(number, len(values) - 1)] for values in several]
        if CHECKED.issuperset(job):
            continue
        worked_out(*job, sweep=sweep)  # what is `auto` is decided from the scene
        CHECKED.update(job)


def each_value(override):
    """`key=value` for each value that a sweep would give it, or for both ends of an interval; of seeds, the first."""
    key, value = override.input_line.split("=", 1)
    if key == "seed" and override.is_sweep_override() and not override.is_interval_sweep():
        return [f"{key}={next(iter(override.sweep_string_iterator()))}"]
    if override.is_interval_sweep():
        return [f"{key}={override.value().start}", f"{key}={override.value().end}"]
    if override.is_sweep_override():
        return [f"{key}={one}" for one in override.sweep_string_iterator()]
    return [f"{key}={value}"]


def check_module(name, arguments):
    """A module that parses arguments is run up to where it has understood them."""
    spec = importlib.util.find_spec(name)
    assert spec, f"no module {name}"
    if spec.submodule_search_locations:
        spec = importlib.util.find_spec(f"{name}.__main__")
    assert spec, f"{name} cannot be run"
    assert spec.origin
    if "parse" in Path(spec.origin).read_text():
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # it was imported before
            parse(lambda: runpy.run_module(name, run_name="__main__", alter_sys=True), [name, *arguments])


def parse(program, arguments):
    """Calls a program up to where it has parsed its arguments. One that is only mentioned has to have a help text."""

    def understood(parse_known):
        def stop(self, args=None, namespace=None):
            _, unknown = parse_known(self, args, namespace)
            if unknown:
                self.error(f"unrecognized arguments: {' '.join(unknown)}")
            raise Parsed

        return stop

    mentioned = len(arguments) == (2 if arguments[0] == "qnerf" else 1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("OMP_WAIT_POLICY", "PASSIVE")
        patch.setattr(sys, "argv", [*arguments, *(["--help"] if mentioned else [])])
        parser = argparse.ArgumentParser
        for name, known in (
            ("parse_args", parser.parse_known_args),
            ("parse_intermixed_args", parser.parse_known_intermixed_args),
        ):
            patch.setattr(parser, name, understood(known))
        with pytest.raises((Parsed, SystemExit)) as end:
            program()
    assert end.type is Parsed or (mentioned and end.value.code == 0), f"{arguments}: not understood"
