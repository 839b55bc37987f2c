"""Heads: features -> density, geometry features or colour."""

from qnerf.heads.amplitude import AmplitudeHead
from qnerf.heads.base import HEADS, Head, chosen, head_options
from qnerf.heads.hyper import HyperHead
from qnerf.heads.mlp import MLPHead
from qnerf.heads.qfgn import QFGNHead
from qnerf.heads.qiren import HybridLayer, QirenHead
from qnerf.heads.qiren_bypass import QirenBypassHead
from qnerf.heads.qkan import QKANHead
from qnerf.heads.qnode import QnodeHead, qnode_head
from qnerf.heads.qrun import QRunHead
from qnerf.heads.residual import ResidualHead
from qnerf.heads.siren import SirenHead
from qnerf.heads.surrogate import SurrogateHead
from qnerf.heads.tensor_train import TensorTrainHead

__all__ = [
    "HEADS", "AmplitudeHead", "Head", "HybridLayer", "HyperHead", "MLPHead", "QFGNHead", "QKANHead", "QRunHead",
    "QirenBypassHead", "QirenHead", "QnodeHead", "ResidualHead", "SirenHead", "SurrogateHead", "TensorTrainHead",
    "chosen", "head_options", "qnode_head",
]  # fmt: skip
