"""Check whether adversaries survive conversions.

The conversions are 8 bits, JPEG, reading the files back, and a render by
Mitsuba. `pnb-attack` finds each adversary and renders it again. --overrides are
settings of `pnb-attack`. For example, renderer.shadows=false counts how many
lights that were found without shadows succeed where Mitsuba casts shadows.
"""

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.common import Row
from benchmarks.paper import common

ATTACKS = (
    "lighting",
    "projector",
    "lamps",
    "geometry",
    "albedo",
    "lighting+geometry+albedo",
    "projector+geometry",
)
# Columns of attack.jsonl that the records keep.
KEPT_COLUMNS = ("steps", "success", "success_with_margin", "versions")
# Exit status of `pnb-attack` when it refuses to attack.
REFUSED = 2
ROOT = Path(__file__).parents[2]


def run_attack(overrides: Sequence[str], threads: int) -> Row:
    """Attack one example with `pnb-attack`.

    Args:
        overrides: Settings of `pnb-attack`.
        threads: Number of threads on the CPU.

    Returns:
        KEPT_COLUMNS of the example, or {"refusal": message} if `pnb-attack`
        refused to attack.

    Raises:
        RuntimeError: If the command fails.
    """
    with TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "scripts.attack"]
        command += [f"out={folder}/out", "attack.checks=false", *overrides]
        environment = os.environ | {"OMP_NUM_THREADS": str(threads)}
        done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
        if done.returncode == REFUSED:
            refusal = done.stderr.strip().splitlines()[-1]
            print(f"{' '.join(overrides)}: {refusal}", file=sys.stderr)
            return {"refusal": refusal}
        if done.returncode != 0:
            raise RuntimeError(f"{command} ended with status {done.returncode}: {done.stderr}")
        [file] = Path(folder).glob("out/*/attack.jsonl")
        [line, *_] = file.read_text(encoding="utf-8").splitlines()
    result = json.loads(line)
    return {name: result[name] for name in KEPT_COLUMNS if name in result}


def attack_example(mesh: str, attack: str, example: int, options: argparse.Namespace) -> Row:
    """Attack one view of a mesh.

    Args:
        mesh: Value of --meshes.
        attack: Value of attack= of `pnb-attack`.
        example: Number of the view. The views of a mesh have equally spaced
            azimuths.
        options: Parsed command line.

    Returns:
        Record of the attack.
    """
    settings = common.read_mesh(mesh)
    given_fields = [
        f"{name}:{json.dumps(value)}" for name, value in asdict(settings).items() if value
    ]
    name, _, weights = options.classifier.partition("=")
    overrides = [
        f"attack={attack}",
        f"meshes=[{{{','.join(given_fields)}}}]",
        f"scene.azimuth={360 * example / options.examples}",
        f"seed={options.seed + example}",
        f"network={name}",
        "attack.verify=reload+mitsuba",
    ]
    if weights:
        overrides.append(f"weights={weights}")
    result = run_attack([*overrides, *options.overrides], options.threads)
    record = {"mesh": Path(settings.mesh).stem, "attack": attack, "example": example}
    return record | result


def main(argv: Sequence[str] | None = None) -> None:
    """Attack views of each mesh with each attack, and append a record for each.

    Args:
        argv: Words of the command line. None takes those of the process.
    """
    parser = common.make_parser("survival", __doc__)
    add = parser.add_argument
    add("--examples", type=int, default=2, help="views of each mesh and attack, at equal azimuths")
    add("--attacks", nargs="+", default=ATTACKS, help="as attack= of pnb-attack")
    add("--overrides", nargs="*", default=[], help="settings of pnb-attack: attack.max_steps=10")
    options = parser.parse_args(argv)
    common.begin_run(options)
    examples = range(options.examples)
    for mesh, attack, example in product(options.meshes, options.attacks, examples):
        common.append(options.out, attack_example(mesh, attack, example, options))


if __name__ == "__main__":
    main()
