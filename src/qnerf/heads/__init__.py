"""Features -> values: what a field's density and colour heads are made of."""

from qnerf.heads.base import HEADS, Head, chosen, head_options
from qnerf.heads.mlp import MLPHead
from qnerf.heads.qfgn import QFGNHead
from qnerf.heads.qiren import HybridLayer, QirenHead

__all__ = ["HEADS", "Head", "HybridLayer", "MLPHead", "QFGNHead", "QirenHead", "chosen", "head_options"]
