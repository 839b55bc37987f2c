"""`qnerf show RUN`: everything about one run."""

import argparse
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import yaml  # type: ignore[import-untyped]
from rich.console import Console
from rich.table import Table
from rich.text import Text

from qnerf.cli.commands import add_run
from qnerf.cli.table import Column, metric_column, print_table
from qnerf.cli.text import STATE_STYLES, age, as_json, console, count, duration, measured, missing, styled
from qnerf.config.checks import is_number
from qnerf.config.identity import flatten
from qnerf.metrics import Metric, metric_of, shown_quality
from qnerf.records import details, find
from qnerf.records.printable import printable
from qnerf.records.schemas import is_own

Run = dict[str, Any]
"""What `details.read` gives."""


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = "Everything about one run: state, results, held-out views, environment."
    add_run(parser)
    parser.add_argument("--config", action="store_true", help="the whole configuration too")
    parser.add_argument("--json", action="store_true", help="all of it as one object")


def main(options: argparse.Namespace) -> None:
    run = details.read(find(options.run, options.store))
    if options.json:
        print(as_json(run))
    else:
        show(console(), run, options.config)


def show(out: Console, run: Run, config: bool = False) -> None:
    _head(out, run)
    _results(out, run)
    _views(out, run)
    if config:
        _section(out, "configuration")
        out.print(yaml.safe_dump(run["config"], sort_keys=False).rstrip(), soft_wrap=True)
    _environment(out, run)
    out.print()
    pair(out, "folder", run["path"])


def _head(out: Console, run: Run) -> None:
    out.print(styled(run["run_id"], "bold"), soft_wrap=True)
    out.print(state_line(run), soft_wrap=True)
    if run["error"] and run["state"] != "finished":
        out.print(styled(run["error"], "red", 2000), soft_wrap=True)
    for problem in run["problems"]:
        out.print(styled(problem, "red", 2000), soft_wrap=True)
    if run["overrides"]:
        pair(out, "overrides", " ".join(run["overrides"]))


def state_line(run: Run) -> Text:
    """`finished  1,500 of 1,500 steps  started 12m ago on HOST, process 12`"""
    line = styled(run["state"], STATE_STYLES.get(run["state"], ""))
    status, steps = run["status"], flatten(run["config"]).get("train.steps")
    line.append(f"  {count(run['step'])}{'' if steps is None else f' of {count(steps)}'} steps")
    if "created" in status:
        line.append(f"  started {age(status['created'])} ago")
    if run["state"] == "running":
        line.append(printable(f" on {status.get('host')}, process {status.get('pid')}", 200))
    return line


def _results(out: Console, run: Run) -> None:
    if lines := list(results(run["results"], _own_metrics(run["results"], run["config"]))):
        _section(out, "results")
        for name, text in lines:
            pair(out, name, text)


def results(values: Mapping[str, Any], own: Sequence[Metric] = ()) -> Iterator[tuple[str, str]]:
    """Title and text of what a summary says: quality, parameters, times. own: metrics that nobody declared."""
    metrics = [*shown_quality(values), *(item for item in own if not missing(values.get(item.key)))]
    if metrics:
        texts = [f"{item.label} {measured(values[item.key], item, unit=True)}" for item in metrics]
        views = "" if missing(values.get("eval_views")) else f"views {count(values['eval_views'])}"
        yield (
            ("fit", "   ".join(texts)) if "head" in values else ("held out", "   ".join(filter(None, [*texts, views])))
        )
    parts = {key.removeprefix("params."): value for key, value in values.items() if key.startswith("params.")}
    if parts:
        listed = "   ".join(f"{name} {count(value)}" for name, value in parts.items() if value and name != "total")
        yield "parameters", f"{count(parts.get('total'))}: {listed}"
    step = metric_of("step_ms")
    if not missing(values.get("train_s")):
        a_step = f"{measured(values.get('step_ms'), step, unit=True)} per step, {step.explanation}"
        yield "training", f"{duration(values['train_s'])}   {a_step}"
    times = {key[5:-3]: value for key, value in values.items() if key.startswith("time.") and key.endswith("_ms")}
    if times:
        yield "per step", "   ".join(f"{name} {measured(value, step)}" for name, value in times.items()) + " ms"


def _own_metrics(values: Mapping[str, Any], config: Mapping[str, Any]) -> list[Metric]:
    """The numbers of a tracked run that nobody declared, and losses. No result has the name of an option, or a dot."""
    options = flatten(config)
    names = [key for key, value in values.items() if is_own(key) and is_number(value)]
    return [metric_of(name) for name in names if name not in options and "." not in name]


def _views(out: Console, run: Run) -> None:
    views = run["evaluation"]
    if not views:
        return
    _section(out, f"held-out views after step {count(views[0]['step'])}")
    known = dict.fromkeys(item for view in views for item in shown_quality(view))
    metrics = [*known, *_own_metrics(views[0], run["config"])]
    columns = [Column("image", lambda row: str(row["image"])), *map(metric_column, metrics)]
    print_table(out, columns, views)


def _environment(out: Console, run: Run) -> None:
    environment = run["environment"]
    if not environment:
        return
    _section(out, "environment")
    git, cpu, gpu, threads = (_dict(environment.get(name)) for name in ("git", "cpu", "gpu", "threads"))
    if git.get("commit"):
        pair(out, "code", f"{git['commit']}{', with changes (dirty.diff)' if git.get('dirty') else ''}")
    parts = [environment.get("host"), cpu.get("model"), f"cores {cpu.get('usable')}", f"threads {threads.get('torch')}"]
    names = gpu.get("names")
    pair(out, "machine", ", ".join(map(str, [*parts, *(names if isinstance(names, list) else [])])))
    packages = _dict(environment.get("packages"))
    versions = "  ".join(f"{name} {version}" for name, version in packages.items() if version)
    pair(out, "versions", f"python {environment.get('python')}  {versions}")


def _section(out: Console, title: str, more: str = "") -> None:
    out.print()
    out.print(Text.assemble((title, "bold cyan"), f"  {printable(more)}" if more else ""), soft_wrap=True)


def pair(out: Console, name: str, text: str) -> None:
    """A name and its text, which is wrapped beside the name on a terminal."""
    body = Text(printable(text))
    if not out.is_terminal:
        out.print(Text(f"  {name:<10} {body.plain}"), soft_wrap=True)
        return
    grid = Table.grid(padding=(0, 1, 0, 2), pad_edge=True, collapse_padding=False)
    grid.add_column(width=10, style="dim")
    grid.add_column(overflow="fold")
    grid.add_row(name, body)
    out.print(grid)


def _dict(value: Any) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}
