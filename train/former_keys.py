"""Settings that had other names in earlier versions.

Commands and the config.yaml of earlier runs may still use the former names.
"""

from __future__ import annotations

from typing import Any

# The last part of the present key, by the former key.
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
    """Replace a former key in a word of the command line, such as augment.every=60.

    Args:
        word: Word of the command line, with any number of leading plus signs.

    Returns:
        The word with the present key. A word with another key is unchanged.

    >>> replace_former_key("augment.every=60")
    'augment.regenerate_every=60'
    """
    key, equals, value = word.partition("=")
    name = key.lstrip("+")
    if name not in FORMER_KEYS:
        return word
    signs = key[: len(key) - len(name)]
    group, dot, _ = name.rpartition(".")
    return f"{signs}{group}{dot}{FORMER_KEYS[name]}{equals}{value}"


def rename_former_keys(config: dict[str, Any]) -> None:
    """Rename former keys in the contents of a config.yaml, in place.

    Args:
        config: Nested settings by name.
    """
    for former, present in FORMER_KEYS.items():
        *groups, name = former.split(".")
        node: Any = config
        for group in groups:
            node = node.get(group) if isinstance(node, dict) else None
        if isinstance(node, dict) and name in node:
            node[present] = node.pop(name)
