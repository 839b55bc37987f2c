"""The quantum layer alone, in a training loop of one's own: a circuit learns a function of one number.

    python examples/layer.py

A circuit that uploads its input L times in a row is a Fourier series with frequencies up to L (arXiv:2008.08605). So
two uploads fit a target with two frequencies, and one does not.
"""

import argparse

import torch
from torch import Tensor, nn

from qnerf import QuantumLayer


class Series(nn.Module):
    """x (N, 1), radians -> (N, 1): a linear map of what every wire measures."""

    def __init__(self, wires: int, uploads: int) -> None:
        super().__init__()
        self.circuit = QuantumLayer(wires=wires, spectral=uploads)  # angles (..., wires) -> <Z> of each wire
        self.readout = nn.Linear(wires, 1)

    def forward(self, x: Tensor) -> Tensor:
        out: Tensor = self.readout(self.circuit(x.expand(-1, self.circuit.wires)))
        return out


def target(x: Tensor) -> Tensor:
    return 0.5 * torch.sin(x) + 0.3 * torch.cos(2 * x)


def fit(uploads: int, steps: int) -> float:
    """The mean squared error after training, on points between those of the training."""
    torch.manual_seed(0)
    model = Series(1, uploads)
    x = torch.linspace(-torch.pi, torch.pi, 65)[:-1, None]
    optimiser = torch.optim.Adam(model.parameters(), lr=0.05)
    for _ in range(steps):
        loss = (model(x) - target(x)).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    between = x + torch.pi / 64
    with torch.no_grad():
        return float((model(between) - target(between)).square().mean())


def main(steps: int) -> dict[int, float]:
    errors = {uploads: fit(uploads, steps) for uploads in (1, 2)}
    for uploads, error in errors.items():
        print(f"{uploads} upload{'s' * (uploads > 1)}: mean squared error {error:.1e}")
    return errors


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=400)
    main(parser.parse_args().steps)
