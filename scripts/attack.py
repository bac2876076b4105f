"""Attack a classifier through a mesh's light, shape, color or pixels: python scripts/attack.py attack=lighting ..."""

import re
import shlex
import sys
from pathlib import Path

from train import cli  # isort: skip (first, since the others take seconds to import)

import augment
from augment.attacks.attack import logits_of
from augment.attacks.evaluate import RadiusSweep
from augment.attacks.files import LINES
from renderer.errors import InputError
from renderer.rasterizer import choose
from train.attacks.curve import FIGURE, TABLE, curve, format_curve, write_curve
from train.attacks.experiment import attacks
from train.attacks.search import overrides
from train.attacks.settings import AttackExperimentSettings
from train.attacks.text import format_attack, format_reloaded
from train.attacks.transfers import format_transfers, load_others, write_transfers
from train.device import choose_device
from train.errors import writable_folder
from train.networks import load_classifier
from train.run_folder import sole_writer, write_config


def main(settings: AttackExperimentSettings) -> None:
    adversary = augment.reload(settings.reload) if settings.reload else None
    if adversary is None:
        settings.attack.require_parameters()
    device = choose_device(settings.device)
    classifier = load_classifier(settings.classifier, settings.weights).to(device)
    if adversary is not None:
        images = adversary.render(choose(settings.renderer.rasterizer)).to(device)
        logits = logits_of(settings.attack.preprocessed_model(classifier), images[None], len(images))[0]
        print(format_reloaded(adversary, images, logits, classifier.classes))
        if not settings.attack.parameters:
            return
    others = load_others(settings, classifier, device)
    out = writable_folder(settings.out, "out")
    if any(out.glob(f"*/{LINES}")):  # whose examples would lie among the new ones
        raise InputError(f"out={out} holds the adversaries of an earlier call: choose another folder, or remove it")
    sweeps: dict[str, RadiusSweep] = {}
    with sole_writer("out", out):
        for index, (name, scene, attacked) in enumerate(attacks(settings, classifier, device, adversary)):
            if scene != settings.scene:
                print(f"{name} is not recognized in the scene as it is, but is with {overrides(scene, settings.scene)}")
            checks = augment.check(attacked) if settings.attack.checks else None
            folder = out / f"{index}_{Path(name.replace(':', '_')).stem}"
            rerender_checks = augment.save(attacked, folder, checks, settings.attack.renderers)
            print(format_attack(name, attacked, checks, rerender_checks))
            print(f"images, adversaries and numbers: {folder}\n")
            if others:
                found = augment.transfer(attacked, **others)
                write_transfers(found, folder)
                print(f"{format_transfers(found)}\n")
            if settings.attack.radius_scales:
                sweeps[folder.name] = augment.success_by_radius(attacked, settings.attack.radius_scales)
                print(f"{format_curve(sweeps[folder.name])}\n")
        if sweeps:
            write_curve(curve(sweeps), {kind: each.norm for kind, each in settings.attack.parameters.items()}, out)
            print(f"success against radius: {out / TABLE} and {out / FIGURE}")
        write_config(out, settings, command=shlex.join(["python", "scripts/attack.py", *sys.argv[1:]]))


def as_overrides(arguments: list[str]) -> list[str]:
    """attack=lighting+geometry in Hydra's form, attack=[lighting,geometry]; a reloaded adversary is not attacked,
    unless attack= asks for it."""
    keys = {argument.partition("=")[0] for argument in arguments}
    parameters = [re.sub(r"^attack=([^\[].*)$", lambda m: f"attack=[{m[1].replace('+', ',')}]", a) for a in arguments]
    return [*parameters, *(["attack=[]"] if "reload" in keys and "attack" not in keys else [])]


if __name__ == "__main__":
    cli.script(main, AttackExperimentSettings, as_overrides(sys.argv[1:]))
