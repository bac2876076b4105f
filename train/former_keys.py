"""Settings that had other names in earlier versions.

Commands and the config.yaml of earlier runs may still use the former names.
"""

from __future__ import annotations

from typing import Any

# Present name of each setting by its former key. The group is the same: augment.arm is
# now augment.mode.
FORMER_KEYS = {
    "augment.arm": "mode",
    "augment.every": "regenerate_every",
    "augment.attack.shorten": "backtracking",
    "augment.attack.rounded": "quantized",
    "augment.attack.material.strength": "specular_factor",
    "augment.vary.gloss.strength": "specular_factor",
    "attack.shorten": "backtracking",
    "attack.rounded": "quantized",
    "attack.material.strength": "specular_factor",
    "train.accumulate": "accumulation_steps",
    "train.ranking": "ranking_weight",
    "train.distillation": "distillation_weight",
    "look_alikes": "hard_negatives",
}


def replace_former_key(word: str) -> str:
    """Replace the former key of a setting in an argument of the command line.

    The key may begin with plus signs. Other keys stay.
    """
    key, equals, value = word.partition("=")
    name = key.lstrip("+")
    if name not in FORMER_KEYS:
        return word
    signs = key[: len(key) - len(name)]
    group, dot, _ = name.rpartition(".")
    return f"{signs}{group}{dot}{FORMER_KEYS[name]}{equals}{value}"


def rename_former_keys(config: dict[str, Any]) -> None:
    """Rename settings with former keys, in place, in the contents of a config.yaml."""
    for former, present in FORMER_KEYS.items():
        *groups, name = former.split(".")
        node: Any = config
        for group in groups:
            node = node.get(group) if isinstance(node, dict) else None
        if isinstance(node, dict) and name in node:
            node[present] = node.pop(name)
