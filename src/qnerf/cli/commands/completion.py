"""`qnerf completion bash|zsh|fish`: the script that completes commands, options and ids of runs."""

import argparse
import importlib
from collections.abc import Callable
from typing import Any, NoReturn
from unittest import mock

from qnerf.cli.commands import ANALYSIS, COMMANDS, RUN
from qnerf.cli.errors import Parser
from qnerf.config.folders import SWEEPS

SHELLS = ("bash", "zsh", "fish")

RUNS = {
    "bash": "_qnerf_runs",
    "zsh": "_qnerf_runs",
    "fish": "(_qnerf_runs)",
    "preamble": {
        "bash": """\
_qnerf_runs() {  # $1: the beginning of an id
  local store=runs i
  for ((i = 1; i < COMP_CWORD; i++)); do
    [[ ${COMP_WORDS[i]} == --store ]] && store=${COMP_WORDS[i + 1]}
  done
  compgen -W "$(command ls -- "$store" 2>/dev/null)" -- "$1"
}
""",
        "zsh": """\
_qnerf_runs() {
  local store=runs i
  for ((i = 1; i < CURRENT; i++)); do
    [[ $words[i] == --store ]] && store=$words[i+1]
    [[ $words[i] == --store=* ]] && store=${words[i]#--store=}
  done
  compadd -- ${(f)"$(command ls -- $store 2>/dev/null)"}
}
""",
        "fish": """\
function _qnerf_runs
  set -l store runs
  set -l words (commandline -opc)
  for i in (seq (count $words))
    switch $words[$i]
      case --store
        set store $words[(math $i + 1)]
      case '--store=*'
        set store (string replace -- --store= '' $words[$i])
    end
  end
  command ls -- $store 2>/dev/null
end
""",
    },
}
"""What a shell calls for the ids of runs, and its definition. It lists the store's folder, which takes no time."""


class _Found(Exception):
    """A command has made its parser, `args[0]`."""


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = "Prints a shell's script that completes commands, options and ids of runs."
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = (
        "  bash  qnerf completion bash > ~/.local/share/bash-completion/completions/qnerf\n"
        "  zsh   qnerf completion zsh > FOLDER/_qnerf, with a FOLDER of $fpath\n"
        "  fish  qnerf completion fish > ~/.config/fish/completions/qnerf.fish"
    )
    parser.add_argument("shell", choices=SHELLS)


def main(options: argparse.Namespace) -> None:
    try:
        import shtab
    except ModuleNotFoundError:
        raise ValueError('qnerf completion needs shtab: pip install "qnerf[completion]"') from None
    parser = argparse.ArgumentParser("qnerf")
    parser.add_argument("--version", action="store_true")
    commands = parser.add_subparsers()
    for name, purpose in COMMANDS.items():
        own = commands.add_parser(name, parents=[parser_of(name)], add_help=False, help=purpose, description=purpose)
        for action in own._actions:
            if action.metavar == "RUN" or action.help == RUN:
                action.complete = RUNS  # type: ignore[attr-defined]
            elif action.metavar in ("DIR", "STORE", "FOLDER"):
                action.complete = shtab.DIRECTORY  # type: ignore[attr-defined]
    print(shtab.complete(parser, options.shell))


def parser_of(command: str) -> argparse.ArgumentParser:
    """The parser of a command, without running it."""
    if command == "run":
        return _parser_of_run()
    if command not in ANALYSIS:
        parser = Parser(prog=f"qnerf {command}")
        importlib.import_module(f"qnerf.cli.commands.{command}").arguments(parser)
        return parser
    # Commands of the analysis make their parser and parse in one function.
    start: Callable[[list[str]], Any] = importlib.import_module(f"qnerf.analysis.{ANALYSIS[command]}").main
    with mock.patch.multiple(Parser, parse_args=_found, parse_intermixed_args=_found):
        try:
            start([])
        except _Found as found:
            parser = found.args[0]
            assert isinstance(parser, Parser)
            return parser
    raise AssertionError(f"{command} parses no arguments")


def _found(parser: argparse.ArgumentParser, *_: object) -> NoReturn:
    raise _Found(parser)


def _parser_of_run() -> argparse.ArgumentParser:
    """The options of `qnerf run` that are its own or that its documentation names; Hydra parses them."""
    parser = Parser(prog="qnerf run")
    parser.add_argument("-m", "--multirun", action="store_true", help="train every combination of values")
    parser.add_argument("--sweep", choices=sorted(file.stem for file in SWEEPS.glob("*.yaml")), help="a stored sweep")
    parser.add_argument("--cfg", choices=["job"], help="print the configuration without training")
    return parser
