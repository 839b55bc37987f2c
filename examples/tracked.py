"""A training loop of one's own, as a run of a store like those that qnerf trains.

    python examples/tracked.py --width 2
    qnerf decide "python examples/tracked.py --width 2" "python examples/tracked.py --width 32"

A small network learns a picture of stripes. `qnerf.track` keeps each training as a run: it resumes, and stands in
`qnerf runs`, tables and pages beside qnerf's own. `qnerf decide` starts the script with one seed after the other, in
QNERF_SEED, until it is decided which width is better.
"""

import argparse
import os

import torch
from torch import nn

import qnerf
from qnerf.training.trainer import decibels


def train(width: int, seed: int, steps: int) -> None:
    """Trains a run, or continues it, or leaves it as it is where it is finished."""
    torch.manual_seed(seed)
    model = nn.Sequential(nn.Linear(1, width), nn.Tanh(), nn.Linear(width, 1))
    optimiser = torch.optim.Adam(model.parameters(), lr=0.1)
    x = torch.linspace(-1, 1, 64)[:, None]
    stripes = 0.5 + 0.5 * torch.sin(4 * x)
    with qnerf.track({"scene": "stripes", "seed": seed, "steps": steps, "width": width}, name="stripes") as run:
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
        run.finish(psnr=decibels((model(x) - stripes).square().mean().item()))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--width", type=int, default=32)
    parser.add_argument("--steps", type=int, default=300)
    options = parser.parse_args()
    train(options.width, int(os.environ.get("QNERF_SEED", 0)), options.steps)
