"""Attack a classifier through a mesh's light, shape, colour or pixels: python scripts/attack.py attack=lighting ..."""

import re
import sys
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from augment.parameters import KINDS
from renderer.errors import InputError
from train.attacks.experiment import attack_mesh
from train.attacks.settings import AttackExperimentSettings
from train.attacks.text import format_attack
from train.cli import one_sentence_errors, script
from train.device import choose_device
from train.outputs import writable_folder
from train.run_classifier import load_classifier
from train.run_folder import sole_writer
from train.settings import read_object, read_settings


def main(config: DictConfig) -> None:
    config = OmegaConf.create(OmegaConf.to_container(config, resolve=True))
    settings = read_settings(AttackExperimentSettings, config)
    settings.attack.require_kinds()
    device = choose_device(settings.device)
    classifier = load_classifier(settings.classifier, settings.weights).to(device)
    out = writable_folder(settings.out, "out")
    with sole_writer("out", out):
        for index, item in enumerate(settings.scene.meshes):
            named = read_object(item, settings.label, index)
            attacked = attack_mesh(named, settings, classifier, device)
            checks = attacked.check() if settings.attack.checks else None
            folder = out / f"{index}_{Path(named.mesh.replace(':', '_')).stem}"
            attacked.save(folder, checks)
            print(format_attack(named.mesh, attacked, checks))
            print(f"images, lights, shapes and numbers: {folder}\n")
        OmegaConf.save(config, out / "config.yaml")


@one_sentence_errors
def _several_kinds(argument: str) -> str:
    """Hydra's form, attack=[lighting,geometry], of attack=lighting+geometry."""
    key, _, kinds = argument.partition("=")
    if key != "attack":
        return argument
    names = [name for name in re.split(r"[+,\s]+", kinds.strip("[]")) if name]
    if unknown := [name for name in names if name not in KINDS]:
        raise InputError(f"attack={unknown[0]} is not known: choose from {', '.join(KINDS)}, several joined by +")
    return f"attack=[{','.join(names)}]"


if __name__ == "__main__":
    sys.argv[1:] = [_several_kinds(argument) for argument in sys.argv[1:]]
    script(main)
