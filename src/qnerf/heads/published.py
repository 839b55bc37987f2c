"""Loads QIREN heads that were trained with the published code (github.com/yeray142/quantum-nerf)."""

import re
from collections.abc import Mapping

from torch import Tensor

from qnerf.heads.qiren import QirenHead

_LAYER = re.compile(r"net\.(\d+)\.(?:(clayer|norm|qlayer\.qnn)\.)?(\w+)")
_NAMES = {"clayer": "linear", "norm": "norm", "qlayer.qnn": "circuit"}


def load_published(head: QirenHead, state: Mapping[str, Tensor], prefix: str = "") -> None:
    """Copies the weights of a published `Hybridren` into `head`, which then returns the same values.

    The published head has no gain and no input scale, so `head` must have `gain=1`, `input_scale=1` and
    `sum_layers=False`, as in `train=paper`.

    Args:
        state: name -> tensor; of a nerfstudio checkpoint, `torch.load(file, weights_only=True)["pipeline"]`.
        prefix: what stands before `net.` in the head's names, such as "_model.field.mlp_head.". Others are ignored.

    Raises:
        ValueError: the head is of another kind, a name or a shape does not match.
    """
    if head.gain != 1 or head.sum_layers or any(layer.input_scale != 1 for layer in head.hybrid):
        raise ValueError("a published head has gain=1, input_scale=1 and sum_layers=false; build the head so")
    translated: dict[str, Tensor] = {}
    for name, tensor in state.items():
        if not name.startswith(prefix + "net."):
            continue
        match = _LAYER.fullmatch(name[len(prefix) :])
        if match is None:
            raise ValueError(f"{name}: not a name of a published head; expected net.N.clayer|norm|qlayer.qnn.NAME")
        index, part, last = match.groups()
        translated[f"hybrid.{index}.{_NAMES[part]}.{last}" if part else f"readout.{last}"] = tensor
    own = head.state_dict()
    missing, unknown = sorted(own.keys() - translated.keys()), sorted(translated.keys() - own.keys())
    if missing or unknown:
        raise ValueError(
            f"the checkpoint does not fit a head of {len(head.hybrid)} circuits: "
            f"missing {', '.join(missing) or 'nothing'}; left over {', '.join(unknown) or 'nothing'}"
        )
    for name, tensor in translated.items():
        if tensor.shape != own[name].shape:
            raise ValueError(f"{name}: expected shape {tuple(own[name].shape)}, got {tuple(tensor.shape)}")
    head.load_state_dict(translated)
