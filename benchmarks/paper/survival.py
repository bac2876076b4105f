"""Do adversaries still succeed in 8 bits, as JPEG, read back from their files, and in Mitsuba?

Each is found and rendered anew by pnb-attack; --overrides are its own, such as renderer.shadows=false to
count how many lights that were found without shadows succeed where Mitsuba casts them.
"""

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

ATTACKS = ("lighting", "projector", "lamps", "geometry", "albedo", "lighting+geometry+albedo", "projector+geometry")
KEPT = ("refusal", "steps", "success", "success_with_margin", "versions")
ROOT = Path(__file__).parents[2]


def run_attack(overrides: Sequence[str], threads: int) -> Row:
    """The numbers of one example that pnb-attack attacks, {"refusal": its sentence} where it ended in one."""
    with TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "scripts.attack", f"out={folder}/out", "attack.checks=false", *overrides]
        environment = os.environ | {"OMP_NUM_THREADS": str(threads)}
        done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
        if done.returncode == 2:
            return {"refusal": done.stderr.strip().splitlines()[-1]}
        if done.returncode:
            raise RuntimeError(f"{command} ended with {done.returncode}: {done.stderr}")
        [lines] = Path(folder).glob("out/*/attack.jsonl")
        return json.loads(lines.read_text(encoding="utf-8").splitlines()[0])


def main(argv: Sequence[str] | None = None) -> None:
    options = common.parser("survival", __doc__)
    options.add_argument("--examples", type=int, default=2, help="of each mesh and attack, at equal azimuths")
    options.add_argument("--attacks", nargs="+", default=ATTACKS, help="as attack= of pnb-attack")
    options.add_argument("--overrides", nargs="*", default=[], help="of pnb-attack: attack.max_steps=10")
    args = options.parse_args(argv)
    common.begin(args)
    name, *weights = args.classifier.split("=", 1)
    chosen = [f"classifier={name}", *(f"weights={path}" for path in weights), "attack.verify=reload+mitsuba"]
    for mesh, attack, example in product(args.meshes, args.attacks, range(args.examples)):
        item = common.read_item(mesh)
        given = (f"{name}:{json.dumps(value)}" for name, value in asdict(item).items() if value)
        view = [f"scene.azimuth={360 * example / args.examples}", f"seed={args.seed + example}"]
        shown = [f"attack={attack}", f"scene.meshes=[{{{','.join(given)}}}]", *view]
        result = run_attack([*shown, *chosen, *args.overrides], args.threads)
        result = {name: result[name] for name in KEPT if name in result}
        common.append(args.out, {"mesh": Path(item.mesh).stem, "attack": attack, "example": example, **result})


if __name__ == "__main__":
    main()
