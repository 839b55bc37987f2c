"""Replaces every `auto` in a configuration by a value that fits the scene."""

import copy
import math
from collections.abc import Mapping
from typing import Any

from qnerf.auto.rules import AUTO, RULES, Decision, Measured
from qnerf.config.registry import Registry
from qnerf.geometry.contraction import CONTRACTIONS
from qnerf.geometry.pose_refinement import CAMERAS
from qnerf.rendering.shading import SHADINGS
from qnerf.scenes import Scene

CHOSEN_BY_RULES: dict[str, Registry[Any]] = {"contraction": CONTRACTIONS, "cameras": CAMERAS, "shading": SHADINGS}
"""Group whose component a rule may choose -> the registry of its components."""


def asked(config: Mapping[str, Any]) -> list[str]:
    """The options that are `auto` and have a rule, in the order in which the rules decide."""
    return [option for option in RULES if _value(config, option) == AUTO]


def resolve(config: Mapping[str, Any], scene: Scene) -> tuple[dict[str, Any], dict[str, Decision]]:
    """Decides each option that is `auto` from the scene's training data. All other options stay as they are.

    Returns the configuration, and each decision with the measurements behind it.

    Raises:
        ValueError: an option that cannot be decided on this scene.
    """
    resolved = copy.deepcopy(dict(config))
    decisions = {}
    measured = Measured(scene)
    for option in asked(config):
        if _value(resolved, option) == AUTO:  # otherwise the component chosen for its group has no such option
            decisions[option] = RULES[option](measured, resolved)
            _decide(resolved, option, decisions[option])
    return resolved, decisions


def columns(decisions: Mapping[str, Decision]) -> dict[str, Any]:
    """Columns of a summary: `needs`, each decision, such as needs.appearance, and what was measured for it."""
    found: dict[str, Any] = {"needs": "auto" if decisions else "none"}
    for option, decision in decisions.items():
        found[f"needs.{option}"] = str(decision.value)
        because = {name: number for name, number in decision.because.items() if math.isfinite(number)}
        found |= {f"needs.{option}.{name}": number for name, number in because.items()}
    return found


def _decide(config: dict[str, Any], option: str, decision: Decision) -> None:
    """Sets a dotted option to its decided value.

    When a component is chosen, options that it does not accept are dropped, and measured ones that are not set are
    added.
    """
    group, _, key = option.rpartition(".")
    node = config[group] if group else config
    node[key] = decision.value
    if key == "name":
        known = CHOSEN_BY_RULES[group].options(node["name"])
        config[group] = {k: v for k, v in {**decision.because, **node}.items() if k == "name" or k in known}


def _value(config: Mapping[str, Any], option: str) -> Any:
    node: Any = config
    for key in option.split("."):
        node = node.get(key) if isinstance(node, Mapping) else None
    return node
