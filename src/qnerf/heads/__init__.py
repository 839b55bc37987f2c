"""Heads: features -> density, geometry features or colour."""

from qnerf.heads.base import HEADS, Head, chosen, head_options
from qnerf.heads.mlp import MLPHead
from qnerf.heads.qfgn import QFGNHead
from qnerf.heads.qiren import HybridLayer, QirenHead

__all__ = ["HEADS", "Head", "HybridLayer", "MLPHead", "QFGNHead", "QirenHead", "chosen", "head_options"]
