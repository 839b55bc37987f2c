"""A training loop of one's own as runs of a store, and as many seeds of it as a verdict takes.

    python examples/tracked.py

Two small networks learn a picture of stripes. `qnerf.track` keeps each training as a run: it resumes, and stands in
`qnerf runs`, tables and pages beside qnerf's own. `qnerf decide` trains configurations of `qnerf run`; for a loop of
one's own its rule is a few lines: look after 6, 9, 14, ... seeds, and spend a share of the 5 % at each look.
"""

import argparse
from pathlib import Path

import torch
from qnerf.analysis.decide.looks import looks, shares
from qnerf.analysis.verdict import verdict
from torch import nn

import qnerf
from qnerf.training.trainer import decibels

WIDTHS = {"narrow": 2, "wide": 32}


def train(name: str, seed: int, steps: int, store: Path) -> float:
    """PSNR in dB of a run, which is trained, continued, or read if it is finished."""
    torch.manual_seed(seed)
    model = nn.Sequential(nn.Linear(1, WIDTHS[name]), nn.Tanh(), nn.Linear(WIDTHS[name], 1))
    optimiser = torch.optim.Adam(model.parameters(), lr=0.1)
    x = torch.linspace(-1, 1, 64)[:, None]
    stripes = 0.5 + 0.5 * torch.sin(4 * x)
    config = {"scene": "stripes", "seed": seed, "steps": steps, "width": WIDTHS[name]}
    with qnerf.track(config, name=name, store=store) as run:
        if run.state is not None:  # it was interrupted, or it is finished
            model.load_state_dict(run.state["model"])
            optimiser.load_state_dict(run.state["optimiser"])
        for step in run.steps(steps):
            loss = (model(x) - stripes).square().mean()
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            run.log(step, {"train/loss": loss.item()})
            if step % 50 == 0 or step == steps:
                run.save({"model": model.state_dict(), "optimiser": optimiser.state_dict()})
        psnr = decibels((model(x) - stripes).square().mean().item())
        run.finish(psnr=psnr)
    return psnr


def main(steps: int, store: Path, most: int = 9) -> str:
    """The verdict on `wide` against `narrow`, with at most `most` seeds each."""
    for seeds in looks(most):
        narrow, wide = ([train(name, seed, steps, store) for seed in range(seeds)] for name in WIDTHS)
        found = verdict(narrow, wide, within=0.5, alpha=shares(most)[seeds])
        print(f"{seeds} seeds: wide - narrow: {found.difference:+.2f} ± {found.reach:.2f} dB, {found.text()}")
        if found.kind != "undecided":
            break
    return found.kind


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--store", type=Path, default=Path("runs-of-the-example"))
    options = parser.parse_args()
    main(options.steps, options.store)
