"""The pages of results: docs/results/NAME/README.md for each question, and docs/results.md, which lists them.

`python -m docs.tools.results docs/results` writes them from packed runs. `qnerf pack` packs the runs of each question
into a folder of its own; `questions.yaml` beside these folders has the questions.
"""

import argparse
import re
from collections.abc import Hashable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
import yaml  # type: ignore[import-untyped]
from qnerf.analysis import command, load
from qnerf.analysis.decide.records import records
from qnerf.analysis.figures.files import title
from qnerf.analysis.selection import SCENES, label, validating
from qnerf.analysis.tables import Table, stability
from qnerf.analysis.tables.table import markdown_escape

from docs.tools.question import Question
from qnerf.metrics import metric_of
from qnerf.records.files import one_line, replace
from qnerf.records.printable import printable

INDEX = """\
# Results

One line a question: what its runs say, and the page with the table and the commands.

- PSNR is of the held-out views (5 of `fox_64`, 22 of `poster`) at the end of training. ± is the standard deviation over
  seeds. Bold is the best of a column. [analysis.md](analysis.md#verdicts) explains the verdicts: one without a scene
  holds on each scene of the page. A row without its number of seeds has all that its page names.
- The commands train on `poster`; add [the options](your-scene.md#the-scenes-of-these-pages) of another scene.
- Judged by: `study`, a registered study of `qnerf decide`, with `--tune` after a search of each head's options; its
  page says which of its runs are older than its record. `table`: runs of a sweep, without a registered study or a
  search.
- *Earlier rate*: these runs with `train=quick` had the learning rate that it had at first
  ([recipe.md](recipe.md#how-the-learning-rate-falls)). They are not judged anew yet: {earlier}.
  `train.schedule=exponential train.cooldown=1 train.lr_final=1e-4 train.betas=[0.9,0.999]` repeats them; from before
  `train=quick` gave MLPs He's initial weights, `density.mlp.init=torch`; from before it halved the proposal networks'
  samples, `proposal.samples=[128,64]`.
- Compare times of a step by `python -m benchmarks.training`: runs of a table were not all trained at the same time.
  {hardware}

| question | judged by | what the runs say |
|---|---|---|
"""
NO_STUDY = "The verdicts are of this table, without a registered study."
MOST_NAMED = 3
"""Rows beside the baseline that the index names one by one; of more it counts the verdicts."""


def pages(folder: Path) -> dict[Path, str]:
    """File -> page in Markdown, for each question whose folder exists; hardware.txt describes the machine.

    Raises:
        ValueError: there is no folder of packed runs, or one that belongs to no question.
    """
    asked = questions(folder)
    present = {path.parent.name for path in folder.glob("*/runs.parquet")}
    unknown = sorted(present - set(asked))
    if not present or unknown:
        raise ValueError(
            f"{folder}: expected folders of packed runs, among {', '.join(asked)}; got {', '.join(unknown) or 'none'}"
        )
    made, lines, earlier = {}, [], pd.Series(dtype=float)  # seconds of training
    for name, question in asked.items():
        if name in present:
            made[folder / name / "README.md"], said = page(folder / name, question)
            judged = "study" if said.study else "table"
            if len(said.earlier):
                earlier, judged = pd.concat([earlier, said.earlier]), f"{judged}, earlier rate"
            lines.append(f"| [{question.title}]({folder.name}/{name}/README.md) | {judged} | {said.text} |")
    earlier = earlier[~earlier.index.duplicated()]  # pages share runs
    left = f"{len(earlier):,} runs, {earlier.sum() / 3600:.0f} hours of training"
    file = folder / "hardware.txt"
    hardware = " ".join(printable(file.read_text(), lines=True).split()) if file.is_file() else ""
    return {folder.with_suffix(".md"): INDEX.format(hardware=hardware, earlier=left) + "\n".join(lines) + "\n"} | made


def questions(folder: Path) -> dict[str, Question]:
    """The questions of questions.yaml, in its order: the name of a folder of packed runs -> its question.

    Raises:
        ValueError: there is no such file, or an entry is no `Question`.
    """
    file = folder / "questions.yaml"
    if not file.is_file():
        raise ValueError(f"{file}: expected the questions that folders of packed runs answer; there is no such file")
    try:
        return {name: Question(**options) for name, options in yaml.safe_load(file.read_text()).items()}
    except (TypeError, AttributeError, yaml.YAMLError) as error:
        raise ValueError(f"{file}: {one_line(error)}") from error


class Said(NamedTuple):
    """What the index says of a question: its verdicts, whether studies gave them; run -> training seconds, of its runs
    with the learning rate that `train=quick` had at first."""

    text: str
    study: bool
    earlier: pd.Series


def page(folder: Path, question: Question) -> tuple[str, Said]:
    """The page of a question's packed runs, and its line in the index."""
    frame = load.runs(folder)
    tables = question.tables(frame)
    shown = question.instead(frame) or beside(tables, question)
    commands = (*question.commands, question.table_command(folder.name))
    parts = [f"# {question.title}", trained(frame)]
    parts += ["\n".join(f"    {line}" for line in commands), without_repetition(shown, frame).markdown()]
    looks = pd.DataFrame([look for look in records(folder).to_dict("records") if look["seeds"]])
    parts += [studied(looks)] if len(looks) else [NO_STUDY] if question.baseline else []
    if question.metric == "psnr" and not question.best_of and (failed := failures(stability(frame, question.rows))):
        parts.append(failed)
    parts += [f"[{file.name}]({file.name})" for file in sorted(folder.glob("*.md")) if file.name != "README.md"]
    parts += [f"![{title(file.stem)}]({file.name})" for file in sorted(folder.glob("*.png"))]
    text = decided(looks) if len(looks) else verdicts(tables[0], question)
    earlier = frame.set_index("run_id").loc[lambda runs: runs["train"].eq("quick") & ("train.schedule" not in runs)]
    return "\n\n".join(parts) + "\n", Said(text, len(looks) > 0, earlier["train_s"])


def studied(looks: pd.DataFrame) -> str:
    """What `qnerf decide` has said of these runs, and what it searched."""
    parts = ["The table's verdicts are of one look. By `qnerf decide`, whose intervals hold over all looks and pairs:"]
    for (scene, _, metric), study in looks.groupby(["scene", "registered", "metric"], sort=False):
        measured = "" if metric == "psnr" else metric_of(metric).label
        for baseline, here in study.groupby("baseline", sort=False):
            parts.append(f"{', '.join(filter(None, (scene, measured, f'against {_short(baseline)}')))}:")
            parts.append("\n".join(f"- {_short(look['candidate'])}: {_said(look)}" for look in here.to_dict("records")))
        searches = dict.fromkeys(found for said in study["searched"] for found in said.split("; ") if found)
        named = (found.partition(":") for found in searches)
        chosen = "\n".join(f"- {_short(candidate)}:{found}" for candidate, _, found in named)
        parts += ["Chosen by the search:", chosen] if searches else []
        parts += [f"Of this record: {told}." for told in dict.fromkeys(study["changes"]) if told]
    return "\n\n".join(parts)


def decided(looks: pd.DataFrame) -> str:
    """What the index says of a question that studies have answered: their verdicts on each other candidate against the
    first one, of many the counts."""
    said = []
    for (scene, about, *_), study in looks.groupby(["scene", "about", "registered", "metric"], sort=False):
        kinds: dict[str, list[str]] = {}
        for look in study.to_dict("records"):
            if about in (look["candidate"], look["baseline"]):
                kind = str(re.match(r"\w+", look["verdict"])[0])  # type: ignore[index]
                other = look["candidate"]
                if other == about:
                    kind, other = {"better": "worse", "worse": "better"}.get(kind, kind), look["baseline"]
                kinds.setdefault(kind, []).append(_short(other))
        told = [
            f"{kind}: {', '.join(kinds[kind]) if len(kinds[kind]) <= MOST_NAMED else len(kinds[kind])}"
            for kind in KINDS
            if kind in kinds
        ]
        said.append(f"{scene + ', ' if scene else ''}against {_short(about)}: {', '.join(told)}")
    return "; ".join(said)


def _short(candidate: Hashable) -> str:
    """`color=mlp width=41` for `color=mlp color.mlp.width=41`."""
    return re.sub(r"(?<= )[\w.]+\.(\w+=)", r"\1", str(candidate))


def _said(look: Mapping[Hashable, Any]) -> str:
    difference = f"{look['shown']} {metric_of(look['metric']).unit}".rstrip()
    return f"{difference}, {re.sub(', after .* trials each', '', look['verdict'])}, {look['seeds']} seeds"


def scene_key(rows: Sequence[str]) -> str:
    """The key that tells the scenes of a question apart; empty where it has none."""
    return next((key for key in rows if key in (*SCENES, "scene.shape")), "")


def trained(frame: pd.DataFrame) -> str:
    """`60 runs; train=quick, 1,500 steps; seeds 0 to 2.`, without the runs of a search."""
    frame = frame[~validating(frame)]
    steps = frame.groupby("train")["train.steps"].unique()
    budgets = "; ".join(
        f"`train={recipe}`, {', '.join(f'{n:,.0f}' for n in sorted(numbers))} steps"
        for recipe, numbers in steps.items()
    )
    seeds = sorted(frame["seed"].unique())
    seeds = f"seeds {seeds[0]:.0f} to {seeds[-1]:.0f}" if len(seeds) > 1 else f"seed {seeds[0]:.0f}"
    return f"{len(frame)} runs; {budgets}; {seeds}."


def without_repetition(table: Table, frame: pd.DataFrame) -> Table:
    """The table without columns that say the same in all rows, which a note says once, and without empty ones.

    The paper's numbers go where none of ours stand beside them, the number of seeds where each row has all of them.
    """
    text = table.text
    empty = [name for name in text if not text[name].any()]
    empty += [name.replace(": ours", ": paper") for name in empty]
    alike = [name for name in text if len(text) > 1 and name not in empty and text[name].nunique() == 1]
    shown = [name for name in text if name not in (*empty, *alike)]
    said = {name: text[name].iloc[0] for name in alike}
    if said.get("seeds") == str(frame["seed"].nunique()):
        said.pop("seeds")
    notes = [f"In each row: {'; '.join(f'{name} {value}' for name, value in said.items())}."] if said else []
    return Table(table.title, text[shown], table.data, table.bold[shown], (*notes, *table.notes))


def beside(tables: Sequence[Table], question: Question) -> Table:
    """The question's tables as one: the metric, the verdicts against each baseline, the means of other values.

    The difference of two baselines is said once, in the row of the later one.
    """
    first = tables[0].text
    own = metric_of(question.metric).heading
    shown, bold = first[[*question.rows, own]].copy(), tables[0].bold[[*question.rows, own]].copy()
    for table, (metric, baseline) in zip(tables, question.comparisons, strict=True):
        if baseline is not None:
            measured = metric_of(metric).heading
            heading = f"{measured}, " * (metric != question.metric) + f"against {label(tuple(baseline.values()))}"
            shown[heading], bold[heading] = against(table.text, measured), False
            if table is not tables[0]:
                shown.loc[first["verdict"] == "", heading] = ""
    for name in first.columns.difference(shown.columns, sort=False):
        if name not in (f"difference, {own}", "verdict"):
            shown[name], bold[name] = first[name].str.partition(" ± ")[0], tables[0].bold[name]
    kept = kept_rows(tables[0], question)
    notes = (f"Of several values of {question.best_of} the best one is shown, and the baseline's.",) * (not kept.all())
    return by_scene(Table("", shown[kept], tables[0].data, bold[kept], notes), question.rows)


def kept_rows(table: Table, question: Question) -> pd.Series:
    """Which rows a page shows: those with the best value of the key `best_of`, where there is one, and the baseline."""
    if not question.best_of:
        return pd.Series(True, table.text.index)
    means = metric_of(question.metric).sign * table.data[(question.metric, "mean")]
    others = [key for key in question.rows if key != question.best_of]
    best = pd.Series((means == means.groupby(level=others).transform("max")).to_numpy(), table.text.index)
    return best if question.baseline is None else best | (table.text["verdict"] == "")


def against(text: pd.DataFrame, metric: str) -> list[str]:
    """`-1.22 ± 0.67 worse *`, without what is ruled out and which runs slipped; empty in the baseline's row."""
    differences = text[f"difference, {metric}"]
    said_elsewhere = r"(?<=undecided): .*? is ruled out|; (baseline )?slipped \d+ of \d+"
    kinds = text["verdict"].str.replace(said_elsewhere, "", regex=True)
    return [f"{difference} {kind}".strip() for difference, kind in zip(differences, kinds, strict=True)]


def by_scene(table: Table, keys: Sequence[str]) -> Table:
    """The table with a row for what several rows of two or three scenes have in common.

    The columns that differ between the scenes come once for each, as `SCENE: COLUMN`.
    """
    text = table.text
    key = scene_key(keys)
    rows = [name for name in keys if name != key]
    scenes = list(dict.fromkeys(text[key])) if key else []
    if not rows or len(scenes) not in (2, 3):
        return table
    parts = {scene: text[text[key] == scene].set_index(rows).drop(columns=key) for scene in scenes}
    marks = {scene: table.bold.loc[(text[key] == scene).to_numpy()] for scene in scenes}
    index = text.set_index(rows).index.unique()
    shown, bold = index.to_frame(index=False), pd.DataFrame(False, range(len(index)), rows)
    for name in next(iter(parts.values())).columns:
        columns = {scene: part[name].reindex(index) for scene, part in parts.items()}
        alike = pd.DataFrame({scene: list(column) for scene, column in columns.items()}).ffill(axis=1).bfill(axis=1)
        if (alike.nunique(axis=1) == 1).all() and not marks[scenes[0]][name].any():
            shown[name], bold[name] = list(alike.iloc[:, 0]), False
            continue
        for scene, column in columns.items():
            heading = f"{scene}: {name}"
            shown[heading] = list(column.fillna(""))
            bold[heading] = list(marks[scene][name].set_axis(parts[scene].index).reindex(index, fill_value=False))
    return Table(table.title, shown, table.data, bold, table.notes)


def failures(table: Table) -> str:
    """The rows of several seeds that slipped or collapsed, of the table of stability; empty where none did."""
    found: dict[str, list[str]] = {}
    for row in table.text[(table.data["n"] > 1).to_numpy()].to_dict("records"):
        for kind in ("slipped", "collapsed"):
            if not row[kind].startswith("0 "):
                name = " ".join(str(row[key]) for key in table.data.index.names)
                found.setdefault(f"{row[kind]} {kind}", []).append(markdown_escape(name))
    said = "; ".join(f"{count}: {', '.join(names)}" for count, names in found.items())
    return f"Runs that [failed](../../words.md#from-this-project). {said}." if found else ""


def verdicts(table: Table, question: Question) -> str:
    """What the index says of a question: verdicts of a few rows, of many their counts and which are better; without a
    baseline the best row.
    """
    text = table.text[kept_rows(table, question)]
    where = scene_key(question.rows)
    scene = text[where] if where else pd.Series("", index=text.index)
    keys = [key for key in question.rows if key != where]
    name = text[keys].apply(", ".join, axis=1) if keys else scene
    metric = metric_of(question.metric)
    if question.baseline is None:
        means = pd.Series(metric.sign * table.data[(question.metric, "mean")].to_numpy(), table.text.index)[text.index]
        best = means.groupby(scene, sort=False).idxmax()
        shown = text[metric.heading].str.partition(" ")[0]
        return "best: " + "; ".join(
            f"{markdown_escape(name[at])}, {shown[at]} on {where}" for where, at in best.items()
        )
    kind = text["verdict"].str.extract(r"^(\w+)")[0]
    compared = kind.notna()
    baseline = markdown_escape(label(tuple(question.baseline.values())))
    said = []
    if name[compared].nunique() <= MOST_NAMED:
        for row, own in kind[compared].groupby(name[compared], sort=False):
            said.append(f"{markdown_escape(str(row))}: {listed(own.groupby(scene[compared], sort=False).first())}")
    else:
        for where, own in kind[compared].groupby(scene[compared], sort=False):
            counts = own.value_counts()
            better = " and ".join(markdown_escape(one) for one in name[own.index[own == "better"]])
            words = [f"{counts[one]} {one}" + f" ({better})" * (one == "better") for one in KINDS if one in counts]
            said.append(f"{where}: " * bool(where) + ", ".join(words))
    return f"against {baseline}: " + "; ".join(said)


KINDS = ("better", "equivalent", "undecided", "worse")


def listed(kinds: Mapping[str, str] | pd.Series) -> str:
    """`worse on fox_64 and poster, better on chair`; of one kind, the kind alone."""
    groups: dict[str, list[str]] = {}
    for scene, kind in kinds.items():
        groups.setdefault(str(kind), []).append(str(scene))
    if len(groups) == 1:
        return next(iter(groups))
    return ", ".join(f"{kind} on {' and '.join(scenes)}" for kind, scenes in groups.items())


DESCRIPTION = """\
Writes a page for each question that has a folder of packed runs, FOLDER/NAME/README.md, and their index, FOLDER.md.
"""


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=DESCRIPTION)
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="folder of folders that `qnerf pack` wrote")
    options = parser.parse_args(arguments)
    for file, text in pages(options.folder).items():
        replace(file, text.encode(), durable=False)


if __name__ == "__main__":
    command.run(main)
