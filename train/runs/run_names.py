"""Name the folders of the runs of a sweep (several runs that differ in some settings)."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Collection, Sequence
from pathlib import Path

from omegaconf import OmegaConf

from train.run_config import CIRCUMSTANCES

# Largest number of characters of one setting in the name of a folder.
MAX_PART = 48
# Largest number of characters of the name of a folder. File systems allow 255.
MAX_NAME = 200
# Pattern of arguments that set something of Hydra itself, such as "hydra/launcher=...".
HYDRAS_OWN = re.compile(r"\+*hydra[./]")


def run_name(overrides: Sequence[str], fixed: Collection[str] = (), parent: str = "") -> str:
    """Name the folder of a run by the settings that the command line gives.

    For the arguments seed=0 and augment=none, the name is
    `augment-none+seed-0@7d0a3f52`. It has the settings in alphabetical order,
    and ends with a hash of them. Characters that are special to file systems or
    to Hydra are replaced by "_". `fixed` settings count in the hash, but are not shown. A folder in
    `parent` with the same hash keeps its name.
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
