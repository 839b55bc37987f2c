"""The model of a signal: coordinates -> encoder -> one head -> activation -> values."""

from collections.abc import Callable

import torch
from torch import Tensor, nn

from qnerf.config.settings import SignalSettings
from qnerf.config.tensors import returned
from qnerf.encoders import ENCODERS, Encoder
from qnerf.heads import HEADS, head_options
from qnerf.heads.activations import COLOR_ACTIVATIONS
from qnerf.heads.mlp import MLPHead
from qnerf.model.memory import require_parameters


class SignalModel(nn.Module):
    """Points (N, D) in the unit cube -> values (N, C)."""

    def __init__(self, encoder: Encoder, head: nn.Module, activation: Callable[[Tensor], Tensor]) -> None:
        super().__init__()
        self.encoder = encoder
        self.head = head
        self.activation = activation

    @property
    def parts(self) -> dict[str, list[nn.Parameter]]:
        """The parameters, grouped as they are counted and optimised (see `train.rates`)."""
        return {"encoder": list(self.encoder.parameters()), "head": list(self.head.parameters())}

    def forward(self, points: Tensor) -> Tensor:
        raw = self.head(self.encoder(points))
        values: Tensor = returned(self.activation, self.activation(raw), raw.shape, raw)
        return values


def build_signal_model(settings: SignalSettings, in_dim: int, out_dim: int) -> SignalModel:
    """Encoder, head and activation for coordinates and values of a signal, in the run's dtype, on its device.

    Raises:
        ValueError: an encoder that does not take as many coordinates, or more memory than there is.
    """

    def build() -> SignalModel:
        options = {key: value for key, value in settings.encoder.items() if key != "name"}
        encoder = ENCODERS.build_checked(settings.encoder["name"], in_dim, **options)
        head = HEADS.build_checked(settings.head["name"], encoder.out_dim, out_dim, **head_options(settings.head))
        if isinstance(head, MLPHead):
            head.mixed = settings.numerics.precision == "mixed"
        return SignalModel(encoder, head, COLOR_ACTIVATIONS.get(settings.head["activation"]))

    previous = torch.get_default_dtype()
    torch.set_default_dtype(settings.dtype)
    try:
        require_parameters(build)
        torch.manual_seed(settings.seed)
        return build().to(settings.torch_device)
    finally:
        torch.set_default_dtype(previous)
