"""Options that older runs and commands call by another name, and options that older runs lack.

A run keeps its id although options are renamed and added. So `identity` hashes `old_form`: each option under its first
name, and options that were added later only if they change something. Code that reads a stored run translates it with
`upgrade_config` or `today`.
"""

import copy
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

RENAMED = {
    "shading.min_share": "gate.least",
    "shading": "gate",
    "occupancy.min_opacity": "occupancy.least",
    "stop.min_gain_db": "stop.least",
    "numerics.finite_checks": "numerics.check",
    "encoder.frequency_window": "encoder.release",
    "pose_noise": "poses",
    **{f"{head}.mlp.{key}": f"{head}.{key}" for head in ("density", "color") for key in ("layers", "width", "init")},
}
"""Today's name of an option or group -> its first name. The longest match counts."""


@dataclass(frozen=True)
class Same:
    """Stands for the value of another option."""

    option: str


@dataclass(frozen=True)
class Of:
    """Stands for a value where the group has one of these components. Others lack the option, or have it otherwise."""

    names: tuple[str, ...]
    value: Any


_HEADS = ("density", "color")

ADDED: dict[str, Any] = {
    "plugins": [],
    "run.preview_seconds": 30.0,
    "hash.dense": True,
    "color.direction_interval": "signed",
    "color.activation": "sigmoid",
    "color.activations": {"mlp": "sigmoid", "qiren": "sigmoid", "qfgn": "sigmoid"},
    "qiren.ansatz_options": {
        "qiren": {
            "sublayers": 2,
            "entangler": "CZ",
            "ranges": None,
            "axis": "Z",
            "scaling": "unit",
            "scale": 1.0,
            "observable": "Z",
        }
    },
    "scene.width": Of(("nerfstudio", "blender"), None),
    "qiren.shots": None,
    "qiren.patterns": 4,
    "qiren.noise": {
        "depolarizing": 0.0,
        "amplitude_damping": 0.0,
        "phase_damping": 0.0,
        "bit_flip": 0.0,
        "two_qubit": None,
        "readout": 0.0,
        "t1": None,
        "t2": None,
        "one_qubit_time": 0.0,
        "two_qubit_time": 0.0,
    },
    **{f"{head}.qiren.{key}": Same(f"qiren.{key}") for head in _HEADS for key in ("shots", "patterns", "noise")},
    **{f"{head}.qiren.ansatz_options": Same("qiren.ansatz_options") for head in _HEADS},
    **{f"{head}.qfgn.{key}": Same(f"qfgn.{key}") for head in _HEADS for key in ("features", "scale", "gamma")},
}
"""Option that was added later -> the value that does what runs did before."""

_ORIGINAL = dict(sorted(RENAMED.items(), key=lambda names: -len(names[0])))
_TODAY = {old: new for new, old in sorted(RENAMED.items(), key=lambda names: -len(names[1]))}
_noted: set[str] = set()

_Path = tuple[Any, ...]
_Leaves = dict[_Path, Any]


def today(name: str) -> str:
    """Today's name of a dotted option, or of a column of older runs.

    >>> today("gate.least"), today("needs.gate.name.value"), today("psnr")
    ('shading.min_share', 'needs.shading.name.value', 'psnr')
    """
    return f"needs.{today(name[6:])}" if name.startswith("needs.") else _replaced(name, _TODAY)


def today_noted(name: str) -> str:
    """`today` for a name that the user typed. Notes an old name on standard error, once per process."""
    new = today(name)
    if new != name and name not in _noted:
        _noted.add(name)
        print(f"{name} is called {new} now", file=sys.stderr, flush=True)
    return new


def upgrade_config(config: Mapping[str, Any]) -> dict[str, Any]:
    """A stored configuration under today's names.

    >>> upgrade_config({"gate": {"name": "threshold", "least": 0.1}})
    {'shading': {'name': 'threshold', 'min_share': 0.1}}
    """
    return _tree(_renamed(leaves_of(config), _TODAY))


def fill_added(config: dict[str, Any]) -> None:
    """Adds the options in `ADDED` that a stored configuration lacks, with the values that change nothing.

    ValueError if something else stands where a group of options must be.
    """
    for option, value in neutral(config).items():
        *groups, last = option.split(".")
        node = config
        for depth, group in enumerate(groups, start=1):
            node = node.setdefault(group, {})
            if not isinstance(node, dict):
                raise ValueError(f"expected options of {'.'.join(groups[:depth])}, got {node!r}")
        node.setdefault(last, copy.deepcopy(value))


def neutral(config: Mapping[str, Any]) -> dict[str, Any]:
    """Each option in `ADDED` -> the value with which `config` does what it did before the option existed."""
    values: dict[str, Any] = {}
    for option, value in ADDED.items():
        if isinstance(value, Of):
            if value_of(config, f"{option.rpartition('.')[0]}.name") in value.names:
                values[option] = value.value
            continue
        values[option] = value_of(config, value.option, values.get(value.option)) if isinstance(value, Same) else value
    return values


def without_neutral(config: Mapping[str, Any]) -> dict[str, Any]:
    """`config` under today's names, without the options in `ADDED` that change nothing.

    >>> without_neutral({"seed": 0, "plugins": []})
    {'seed': 0}
    """
    config = upgrade_config(config)
    leaves = leaves_of(config)
    for option, value in neutral(config).items():
        path = tuple(option.split("."))
        own = {key: leaf for key, leaf in leaves.items() if key[: len(path)] == path}
        usual = leaves_of(value, path)
        if isinstance(ADDED[option], Same):
            dropped = list(own) if own == usual else []
        else:
            dropped = [key for key, leaf in own.items() if leaf == usual.get(key, {})]
        for key in dropped:
            del leaves[key]
    return _tree(leaves)


def old_form(config: Mapping[str, Any]) -> dict[str, Any]:
    """What `identity` hashes: `without_neutral`, each option under its first name."""
    return _tree(_renamed(leaves_of(without_neutral(config)), _ORIGINAL))


def value_of(config: Mapping[str, Any], option: str, default: Any = None) -> Any:
    """The value of a dotted option; `default` if there is none.

    >>> value_of({"train": {"steps": 10}}, "train.steps")
    10
    """
    node: Any = config
    for key in option.split("."):
        if not isinstance(node, Mapping) or key not in node:
            return default
        node = node[key]
    return node


def leaves_of(node: Any, path: _Path = ()) -> _Leaves:
    """Path of keys -> value. An empty group inside `node` counts as a value."""
    if not isinstance(node, Mapping) or (path and not node):
        return {path: node}
    leaves: _Leaves = {}
    for key, value in node.items():
        leaves |= leaves_of(value, (*path, key))
    return leaves


def _tree(leaves: _Leaves) -> dict[str, Any]:
    tree: dict[str, Any] = {}
    for (*groups, last), value in leaves.items():
        node = tree
        for group in groups:
            if not isinstance(node.get(group), dict):
                node[group] = {}
            node = node[group]
        node[last] = value
    return tree


def _renamed(leaves: _Leaves, names: Mapping[str, str]) -> _Leaves:
    """The leaves under their names in `names`; if both names are there, the renamed leaf wins."""
    renamed: _Leaves = {}
    unchanged: _Leaves = {}
    for path, value in leaves.items():
        new = _renamed_path(path, names)
        (unchanged if new == path else renamed)[new] = value
    return unchanged | renamed


def _renamed_path(path: _Path, names: Mapping[str, str]) -> _Path:
    if not all(isinstance(key, str) for key in path):
        return path
    if path[0] == "needs":  # its keys are dotted names of options
        return path[:1] + tuple(_replaced(key, names) for key in path[1:])
    name = _replaced(".".join(path), names)
    return path if name == ".".join(path) else tuple(name.split("."))


def _replaced(name: str, names: Mapping[str, str]) -> str:
    for prefix, replacement in names.items():
        if name == prefix or name.startswith(f"{prefix}."):
            return replacement + name[len(prefix) :]
    return name
