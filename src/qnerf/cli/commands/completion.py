"""`qnerf completion bash|zsh|fish`: the script that completes commands, options and folders of runs."""

import argparse
import importlib

from qnerf.cli.commands import ANALYSIS, COMMANDS
from qnerf.config.folders import SWEEPS


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = "Prints a shell's script that completes commands, options and the folders of runs."
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = (
        "  bash  qnerf completion bash > ~/.local/share/bash-completion/completions/qnerf\n"
        "  zsh   qnerf completion zsh > FOLDER/_qnerf, with a FOLDER of $fpath\n"
        "  fish  qnerf completion fish > ~/.config/fish/completions/qnerf.fish"
    )
    parser.add_argument("shell", choices=("bash", "zsh", "fish"))


def main(options: argparse.Namespace) -> None:
    try:
        import shtab
    except ModuleNotFoundError:
        raise ValueError('qnerf completion needs shtab: pip install "qnerf[completion]"') from None
    parser = argparse.ArgumentParser("qnerf")
    parser.add_argument("--version", action="store_true")
    commands = parser.add_subparsers()
    for name, purpose in COMMANDS.items():
        command = commands.add_parser(name, help=purpose, description=purpose)
        _declare(name, command)
        for action in command._actions:
            if action.metavar in ("RUN", "DIR", "STORE", "FOLDER"):
                action.complete = shtab.DIRECTORY  # type: ignore[attr-defined]
    print(shtab.complete(parser, options.shell))


def _declare(name: str, parser: argparse.ArgumentParser) -> None:
    """The command's arguments; of those of the analysis, which parse their own, the store alone."""
    if name == "run":  # Hydra parses its options; these are documented
        parser.add_argument("-m", "--multirun", action="store_true", help="train every combination of values")
        sweeps = sorted(file.stem for file in SWEEPS.glob("*.yaml"))
        parser.add_argument("--sweep", choices=sweeps, help="a stored sweep")
        parser.add_argument("--cfg", choices=["job"], help="print the configuration without training")
    elif name in ANALYSIS:
        parser.add_argument("store", metavar="STORE", help="folder of runs, or a packed one")
    else:
        importlib.import_module(f"qnerf.cli.commands.{name}").arguments(parser)
