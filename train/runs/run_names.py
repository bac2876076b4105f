"""The names of the folders of a sweep's runs."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Collection, Sequence
from pathlib import Path

from omegaconf import OmegaConf

from train.settings import CIRCUMSTANCES

# Maximum number of characters of a setting in the name of a folder.
MAX_PART = 48
# Maximum number of characters of the name of a folder. File systems take 255.
MAX_NAME = 200
# Start of the overrides that are settings of Hydra itself.
HYDRAS_OWN = re.compile(r"\+*hydra[./]")


def run_name(overrides: Sequence[str], fixed: Collection[str] = (), parent: str = "") -> str:
    """Name the folder of a run by its settings.

    With seed=0 and augment=none, the name is such as
    `augment-none+seed-0@7d0a3f52`. The settings are in alphabetical order. The
    name ends with a hash of the settings that decide the result. Characters
    that a file system or Hydra's command line might refuse are replaced.

    Args:
        overrides: The overrides of the run.
        fixed: Keys that all runs of the sweep share. They are not shown.
        parent: Folder of the sweep. A run that has a folder there keeps its name.

    Returns:
        The name of the folder.
    """
    pairs = []
    for override in overrides:
        key, _, value = override.partition("=")
        if not HYDRAS_OWN.match(override) and key not in CIRCUMSTANCES:
            pairs.append((key, value))
    pairs.sort()
    digest = hashlib.sha256(repr(pairs).encode(errors="surrogatepass")).hexdigest()
    ending = f"@{digest[:8]}"
    if parent:
        for known in Path(parent).glob(f"*{ending}"):
            return known.name
    shown = [f"{key}-{value}" for key, value in pairs if key not in fixed]
    parts = [re.sub(r"[^\w.-]+", "_", text, flags=re.ASCII)[:MAX_PART] for text in shown]
    return ("+".join(parts) or "run")[:MAX_NAME] + ending


OmegaConf.register_new_resolver("run_name", run_name, replace=True)
