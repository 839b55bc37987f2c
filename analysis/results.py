"""`python -m analysis.results docs/results --write docs/results.md`: the page of what was found out, one section a
question, made from the runs that `python -m analysis.pack` keeps in a folder each."""

import argparse
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from . import command, load
from .figures.files import title
from .paper import PAPER_TABLES
from .tables import Table, ablation, shots_and_noise, stability, units

HEAD = """\
# Results

Every table is made by `python -m analysis.results docs/results --write docs/results.md` from the runs in
`docs/results/`, one folder a question; the last commands of a section make its tables alone, with other `--rows`
other ones. PSNR and SSIM are those of held-out views, 5 of `fox_64` and 22 of `poster`, after the steps that a section
names. Commands are those of `poster`; `fox_64`, the fox capture of instant-ngp at 36 x 64, is the same with
`scene=nerfstudio scene.path=DIR`. Runs of a table were not all trained at the same time: how long a step takes,
`python -m benchmarks.training` measures. Commands with `density.init=torch` are of `train=quick` before its density
MLPs started by He's rule. Figures are drawn of the store by `python -m analysis.pack runs docs/results/NAME --figures
FIGURE`. {hardware}
"""


@dataclass(frozen=True)
class Question:
    """A folder of `docs/results`: what was asked, which sweep answers it, and the table that shows it."""

    title: str
    commands: tuple[str, ...]
    rows: tuple[str, ...]
    baseline: Mapping[str, object] | None = None
    values: tuple[str, ...] = ("psnr", "ssim", "depth_error", "params.color", "params.density")
    stable: bool = False
    alive: bool = False
    measured: bool = False
    paper: tuple[str, ...] = ()
    also: tuple[Mapping[str, object], ...] = ()

    def tables(self, frame: pd.DataFrame) -> list[Table]:
        """Its tables over seeds: differences from the baseline and from `also`, the seeds that failed, how alive colour
        heads are, what hardware would render, the paper's beside ours."""
        values = [name for name in self.values if name in frame and frame[name].notna().any()]
        made = [ablation(frame, self.rows, values=values, baseline=self.baseline)]
        made += [ablation(frame, self.rows, values=("psnr",), baseline=other) for other in self.also]
        if self.stable:
            made.append(stability(frame, self.rows))
        if self.alive:
            made.append(units(frame, self.rows))
        if self.measured:
            made.append(shots_and_noise(frame, self.rows))
        return made + [PAPER_TABLES[name][1](frame) for name in self.paper]

    def shown(self, name: str) -> list[str]:
        """The commands that make its tables over seeds of the committed runs."""
        made = f"python -m analysis.tables docs/results/{name} --rows {','.join(self.rows)}"
        baselines = [] if self.baseline is None else [self.baseline, *self.also]
        told = [",".join(f"{key}={value}" for key, value in baseline.items()) for baseline in baselines]
        return [f"{made} --baseline {one}" for one in told] or [made]


def sweep(name: str, *more: str) -> str:
    return " ".join([f"python -m src.run -cd sweeps -cn {name} budget=short", *more])


def before(name: str, *more: str) -> str:
    """A sweep that was run when density MLPs of the quick recipe started as PyTorch starts them."""
    return sweep(name, *more, "density.init=torch")


def pieces(title: str, command: str, key: str = "experiment", baseline: str = "quick_recipe") -> Question:
    """What values of an option are worth against one of them; experiments change a piece of the quick recipe each."""
    return Question(
        title, (command,), ("scene_name", key), {key: baseline}, ("psnr", "ssim", "depth_error"), stable=True
    )


def density_start(title: str, field: str, rate: str, initial: str) -> Question:
    """What the rate and the start of a density head are worth, against those of the quick recipe."""
    seeds = f"field={field} seed=0,1,2"
    return Question(
        title,
        (
            before("seeds", f"{seeds} train.rates.density=0.33,1.0"),
            before("seeds", f"{seeds} train.rates.density=1.0 density.initial=0.1,1.0"),
        ),
        ("scene_name", "train.rates.density", "density.initial"),
        {"train.rates.density": rate, "density.initial": initial},
        ("psnr", "ssim", "depth_error"),
        stable=True,
        also=() if rate == "1" else ({"train.rates.density": "1", "density.initial": initial},),
    )


SMALL_MLPS = "rgb_mlp_2x27,rgb_mlp_3x16,rgb_mlp_4x13,raw_mlp_3x20,raw_mlp_2x58"

QUESTIONS = {
    "scenes": Question(
        "What does a circuit head give on each scene?",
        (sweep("scenes"),),
        ("scene_name", "field"),
        {"field": "classical"},
    ),
    "start": pieces(
        "How may a density MLP start, below a colour circuit?",
        sweep("seeds", "field=qcolor density.init=torch,he"),
        "density.init",
        "torch",
    ),
    "start_mlp": pieces(
        "And below a colour MLP?",
        sweep("seeds", "field=classical density.init=torch,he"),
        "density.init",
        "torch",
    ),
    "recipe": pieces("What is each piece of the quick recipe worth to a quantum colour head?", sweep("recipe")),
    "recipe_density": pieces(
        "And to one for density?",
        sweep("recipe", "field=qdensity experiment=quick_recipe,no_gain,no_center,no_sum,uniform_angles,full_scale"),
    ),
    "recipe_more": pieces("Would more of it help? Pieces that the recipe does not have", sweep("recipe_more")),
    "seeds": Question(
        "How often does a field collapse? Colour MLPs as Nerfacto's, and with raw directions and He's start",
        (sweep("seeds", "field=classical,qdensity color.directions=raw color.init=he"), sweep("seeds")),
        ("scene_name", "field", "color.init"),
        {"field": "classical", "color.init": "he"},
        ("psnr", "ssim", "depth_error"),
        stable=True,
        also=({"field": "classical", "color.init": "torch"},),
    ),
    "small_heads": Question(
        "Is a quantum colour head level with MLPs of at most 700 parameters?",
        (sweep("small_heads"), sweep("small_heads", "color.init=he", f"experiment={SMALL_MLPS}")),
        ("scene_name", "color", "color.directions", "color.init"),
        {"color": "1L2S"},
        ("psnr", "ssim", "depth_error", "params.color"),
        stable=True,
    ),
    "control": Question(
        "Is it the circuit, or what the recipe gives it?",
        (sweep("control"), sweep("control", "field=qcolor color.directions=raw color.init=torch")),
        ("scene_name", "color", "color.directions", "color.init"),
        {"color": "3x64", "color.directions": "raw", "color.init": "he"},
        ("psnr", "ssim", "depth_error", "params.color"),
        stable=True,
    ),
    "control_density": Question(
        "And a circuit for density?",
        (
            sweep("control_density"),
            sweep("control_density", "field=classical density.init=he color.init=he color.directions=raw"),
            sweep("control_density", "field=qdensity,qboth density.init=torch"),
        ),
        ("scene_name", "field", "density.init", "color.init"),
        {"field": "classical", "density.init": "he", "color.init": "torch"},
        ("psnr", "ssim", "depth_error"),
        stable=True,
        also=({"field": "classical", "density.init": "torch", "color.init": "torch"},),
    ),
    "rates": pieces(
        "How fast may a colour circuit learn?",
        sweep("seeds", "field=qcolor train.rates.color=0.33,1.0"),
        "train.rates.color",
        "1",
    ),
    "rates_mlp": pieces(
        "And a colour MLP?",
        before("seeds", "field=classical seed=0,1,2 train.rates.color=0.33,1.0"),
        "train.rates.color",
        "1",
    ),
    "rates_density": density_start("And a density circuit, and how dense may it start?", "qdensity", "0.33", "0.1"),
    "rates_density_mlp": density_start("And a density MLP?", "classical", "1", "1"),
    "directions": pieces(
        "How loud may the view direction be?",
        before("directions", "train.rates.color=1.0"),
        "color.direction_scale",
        "1",
    ),
    "init": pieces(
        "How loud may a circuit's values be?",
        before(
            "init", "qiren.init=eighth qiren.gain=3,10 seed=0,1,2,3,4 color.direction_scale=1.0 train.rates.color=1.0"
        ),
        "color.qiren.gain",
        "3",
    ),
    "loss_curves": Question(
        "How do training and held-out loss go?",
        (sweep("loss_curves"), "python -m analysis.figures runs loss"),
        ("scene_name", "field"),
        values=("psnr", "ssim", "depth_error"),
    ),
    "sampling": Question(
        "Where are rays to be sampled?",
        (sweep("sampling"), "qnerf evaluate RUN rays", "python -m analysis.figures runs sampling"),
        ("scene_name", "field", "sampler"),
        values=("psnr", "ssim", "depth_error"),
    ),
    "encoders": Question(
        "What are points to be encoded by?",
        (sweep("encoders"), "qnerf evaluate RUN encoding", "python -m analysis.figures runs encodings"),
        ("scene_name", "field", "encoder"),
        values=("psnr", "ssim", "depth_error", "params.encoder", "params.density"),
    ),
    "poses": Question(
        "What does pose refinement make good?",
        (sweep("poses"),),
        ("scene_name", "field", "cameras", "poses.rotation"),
        values=("psnr", "ssim", "depth_error"),
    ),
    "rgb_width": Question(
        "How wide has an MLP of three layers to be?",
        (sweep("rgb_width", "seed=0"), "python -m analysis.figures runs width"),
        ("scene_name", "color"),
        values=("psnr", "ssim", "depth_error", "params.color"),
    ),
    "rgb_depth": Question(
        "How deep may a narrow MLP be?",
        (sweep("rgb_depth", "seed=0"), "python -m analysis.figures runs depth"),
        ("scene_name", "color"),
        values=("psnr", "ssim", "depth_error", "params.color"),
    ),
    "deep": Question(
        "Why does a deep, narrow MLP collapse?",
        (
            before("deep"),
            before("deep", "color.init=torch train.rates.color=0.1,3.0 seed=0,1,2"),
            "qnerf evaluate RUN units",
        ),
        ("scene_name", "color", "color.init", "train.rates.color"),
        values=("psnr", "ssim", "depth_error"),
        stable=True,
        alive=True,
    ),
    "rgb_table": Question(
        "The paper's table of colour heads", (sweep("rgb_table"),), ("scene_name", "field", "color"), paper=("rgb",)
    ),
    "both_table": Question(
        "The paper's table of both heads", (sweep("both_table"),), ("scene_name", "density", "color"), paper=("both",)
    ),
    "hash_table": Question(
        "The paper's hash tables",
        (sweep("hash_table"),),
        ("scene_name", "hash"),
        values=("psnr", "ssim", "depth_error", "params.encoder"),
        paper=("hash",),
    ),
    "pe_widths": Question(
        "Which width does an MLP need on a positional encoding?",
        (sweep("pe_widths"),),
        ("scene_name", "density"),
        values=("psnr", "ssim", "depth_error", "params.density"),
    ),
    "hsv": Question(
        "The paper's colour study",
        (sweep("hsv"), "python -m analysis.tables runs --paper hsv", "python -m analysis.figures runs hsv"),
        ("scene_name", "field"),
        values=("psnr", "ssim", "depth_error", "params.density", "params.color"),
    ),
    "density_figure": Question(
        "The paper's figure of quantum density heads on a positional encoding",
        (sweep("density_figure"), "python -m analysis.figures runs capacity_density"),
        ("scene_name", "density"),
        values=("psnr", "ssim", "depth_error", "params.density"),
    ),
    "density_rate": Question(
        "Two of them end empty. Does a third of the learning rate save them?",
        (
            sweep(
                "density_figure",
                "density.qiren.layers=2,4 density.qiren.spectral=5,6 density.rates.qiren=0.33",
            ),
        ),
        ("scene_name", "density", "train.rates.density"),
        values=("psnr", "ssim", "depth_error"),
    ),
    "density_pe": Question(
        "Is a quantum density head level with an MLP of its size on a positional encoding?",
        (
            sweep("density_pe", "experiment=pe_1L2S,pe_mlp_2x14,pe_mlp_3x12,pe_mlp_2x8"),
            sweep("density_pe", "experiment=pe_mlp_2x14,pe_mlp_3x12,pe_mlp_2x8 density.init=he"),
        ),
        ("scene_name", "density", "density.init"),
        {"density": "1L2S"},
        ("psnr", "ssim", "depth_error", "params.density"),
        stable=True,
    ),
    "density_sum": pieces(
        "Does it help there to read the sum of all circuits?",
        sweep("density_pe", "experiment=pe_1L2S density.qiren.sum_layers=false,true"),
        "density.qiren.sum_layers",
        "false",
    ),
    "ansatz": Question(
        "Which circuit?",
        (sweep("ansatz", "qiren.ansatz=qiren,ry"), sweep("ansatz", "seed=0")),
        ("scene_name", "color.qiren.ansatz"),
        {"color.qiren.ansatz": "qiren"},
        ("psnr", "ssim", "depth_error"),
    ),
    "shots": Question(
        "What do finite shots and noisy gates cost a trained circuit?",
        (
            before("shots"),
            "qnerf evaluate RUN shots=100,1000,10000",
            "qnerf evaluate RUN noise=depolarizing p=0.001,0.01,0.1",
        ),
        ("scene_name", "color"),
        values=("psnr", "params.color"),
        measured=True,
    ),
    "noise": Question(
        "And two re-uploadings, on few enough qubits for exact noise?",
        (before("noise"), "qnerf evaluate RUN noise=depolarizing p=0.001,0.01,0.1"),
        ("scene_name", "color.qiren.qubits"),
        values=("psnr", "params.color"),
        measured=True,
    ),
    "paper_short": Question(
        "Both heads by the paper's recipe and by the quick one, 1,500 steps each",
        (sweep("scenes", "field=qboth train=quick,paper"),),
        ("scene_name", "train"),
        {"train": "paper"},
        ("psnr", "ssim", "depth_error"),
    ),
    "paper": Question(
        "The paper's recipe, 30,000 steps",
        ("python -m src.run -m train=paper field=classical,qcolor",),
        ("scene_name", "field"),
        values=("psnr", "ssim", "depth_error", "step_ms", "train_s"),
    ),
}
"""Folder -> question, in the order of the page."""


def page(folder: Path) -> str:
    """Markdown: a section a folder that is there; hardware.txt says on what machine the runs were done. ValueError
    where there is no such folder, or one that no question knows.
    """
    there = {path.parent.name for path in folder.glob("*/runs.parquet")}
    unknown = sorted(there - set(QUESTIONS))
    if not there or unknown:
        known = ", ".join(QUESTIONS)
        raise ValueError(
            f"{folder}: expected folders of packed runs, among {known}; got {', '.join(unknown) or 'none'}"
        )
    file = folder / "hardware.txt"
    parts = [HEAD.format(hardware=file.read_text().strip() if file.is_file() else "").rstrip()]
    for name, question in QUESTIONS.items():
        if name in there:
            parts += section(name, question, load.runs(folder / name)) + kept(folder / name)
    return "\n\n".join(parts) + "\n"


def kept(folder: Path) -> list[str]:
    """What `analysis.pack` drew beside the tables: of the runs' pictures, curves and probes, which are not kept."""
    tables = [file.read_text().strip() for file in sorted(folder.glob("*.md"))]
    pictures = [
        f"![{title(file.stem)}]({folder.parent.name}/{folder.name}/{file.name})"
        for file in sorted(folder.glob("*.png"))
    ]
    return tables + pictures


def section(name: str, question: Question, frame: pd.DataFrame) -> list[str]:
    budgets = frame.groupby("train")["train.steps"].unique()
    told = "; ".join(
        f"`train={name}`, {', '.join(f'{n:,}' for n in sorted(steps))} steps" for name, steps in budgets.items()
    )
    seeds = ", ".join(map(str, sorted(frame["seed"].unique())))
    commands = "\n".join(f"    {line}" for line in (*question.commands, *question.shown(name)))
    tables = [f"**{table.title}**\n\n{table.markdown()}" for table in question.tables(frame)]
    return [f"## {question.title}", commands, f"{len(frame)} runs; {told}; seeds {seeds}.", *tables]


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m analysis.results", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, help="folder of folders that `python -m analysis.pack` wrote")
    parser.add_argument("--write", type=Path, metavar="FILE", help="the page; default: standard output")
    options = parser.parse_args(arguments)
    text = page(options.folder)
    if options.write:
        options.write.write_text(text)
    else:
        sys.stdout.write(text)


if __name__ == "__main__":
    command.run(main)
