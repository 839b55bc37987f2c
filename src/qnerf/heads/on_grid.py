"""Heads that a compiled loop evaluates together with the hash grid below them."""

from torch import nn

from qnerf.encoders.hash import HashEncoder
from qnerf.heads.mlp import MLPHead
from qnerf.kernels import replaceable
from qnerf.kernels.grid_mlp import Grid, Layer


def layers_on_grid(encoder: nn.Module, head: nn.Module) -> tuple[Grid, Layer, Layer] | None:
    """The arguments of `grid_mlp` that stand for encoder and head; None where the two are something else.

    They are an MLP of two linear layers on a hash grid of three dimensions whose levels are all active from the start.
    """
    if type(encoder) is not HashEncoder or type(head) is not MLPHead or not replaceable(encoder, head):
        return None
    linear = [layer for layer in head.net if isinstance(layer, nn.Linear) and layer.bias is not None]
    if [type(layer) for layer in head.net] != [nn.Linear, nn.ReLU, nn.Linear] or len(linear) != 2:
        return None
    if encoder.in_dim != 3 or encoder.frequency_window:
        return None
    hidden, out = (Layer(layer.weight, layer.bias) for layer in linear)
    return Grid(encoder.table, encoder.resolutions, encoder.dense), hidden, out
