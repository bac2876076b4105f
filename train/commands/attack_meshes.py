"""The attack command: the run over meshes."""

import shlex
import shutil
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from augment.attacks.adversary import Adversary, reload
from augment.attacks.attack import AttackResult, attack, fooled_in_views, logits_of, predictions
from augment.attacks.attack_files import LINES, require_renderers, save
from augment.attacks.checks import check, require_transferable, success_by_radius, transfer
from augment.attacks.descent import Goal
from augment.attacks.eot import preprocessed_model
from augment.attacks.search import find_scene
from augment.attacks.settings import AttackSettings
from augment.classifiers import Classifier
from augment.losses import NO_CLASS
from augment.random_streams import generator
from augment.scene.build import build_scene
from augment.scene.objects import load_object, on_ground
from augment.scene.scene import Scene
from augment.settings import ObjectSettings
from renderer.errors import InputError
from train.command import command_line
from train.command_settings import AttackExperimentSettings, AttackSceneSettings
from train.commands.results import require_replaceable
from train.report.attack_tables import (
    FIGURE,
    TABLE,
    TRANSFERS,
    Sweep,
    format_attack,
    format_sweep,
    write_sweeps,
    write_transfers,
)
from train.runs.run_config import write_config
from train.runs.run_lock import sole_writer
from train.runs.saved_networks import load_network
from train.settings import read_object, read_objects
from train.system.device import choose_device, choose_rasterizer
from train.system.user_errors import keyed, writable_folder


def run(settings: AttackExperimentSettings) -> None:
    """Attack each mesh or the reloaded adversary, write what came of it, and print a summary."""
    with keyed("transfer", vars(settings.transfer)):
        azimuths, meshes = settings.transfer.azimuths, settings.transfer.meshes
        require_transferable(settings.attack.parameters, azimuths, meshes)
    with keyed("attack", vars(settings.attack)):
        require_renderers(settings.attack.renderers)
    adversary = reload(settings.reload) if settings.reload else None
    if adversary is None:
        with keyed("attack"):
            settings.attack.require_parameters()
    device = choose_device(settings.device)
    classifier = load_network(settings.classifier, settings.weights).to(device)
    if adversary is not None:
        images = adversary.render(choose_rasterizer(settings.renderer)).to(device)
        print(format_reloaded(adversary, images, classifier, settings.attack, settings.seed))
        if not settings.attack.parameters:
            return
    others = load_others(settings, classifier, device)
    out = writable_folder(settings.out, "out")
    require_replaceable(out, "out", settings.overwrite)
    sweeps: dict[str, Sweep] = {}
    with sole_writer("out", out):
        _remove_adversaries(out)
        for index, (name, scene, result) in enumerate(attacks(settings, classifier, device, adversary)):
            if scene != settings.scene:
                print(f"{name} is misclassified in the scene as it is, but not with {overrides(scene, settings.scene)}")
            checks = check(result) if settings.attack.checks else None
            folder = out / f"{index}_{Path(name.replace(':', '_')).stem}"
            lines = save(result, folder, checks, settings.attack.renderers)
            print(format_attack(name, result, checks, lines))
            print(f"images, adversaries and numbers: {folder}\n")
            if others:
                print(f"{write_transfers(transfer(result, **others), folder / TRANSFERS)}\n")
            if settings.attack.radius_scales:
                sweeps[folder.name] = success_by_radius(result, settings.attack.radius_scales)
                print(f"{format_sweep(sweeps[folder.name])}\n")
        if sweeps:
            write_sweeps(sweeps, {name: steps.norm for name, steps in settings.attack.parameters.items()}, out)
            print(f"success against radius: {out / TABLE} and {out / FIGURE}")
        write_config(out, settings, command=command_line("attack"))


def _remove_adversaries(out: Path) -> None:
    """Remove those of an earlier call, which the report would count among the new ones."""
    for lines in out.glob(f"*/{LINES}"):
        for example in lines.parent.glob("example_*"):
            shutil.rmtree(example) if example.is_dir() else example.unlink()
        for file in (lines, lines.with_name(TRANSFERS)):
            file.unlink(missing_ok=True)
    for name in (TABLE, FIGURE):
        (out / name).unlink(missing_ok=True)


def attacks(
    settings: AttackExperimentSettings, classifier: Classifier, device: torch.device, adversary: Adversary | None = None
) -> Iterator[tuple[str, AttackSceneSettings, AttackResult]]:
    """(name, settings of the attacked scene, result) of an adversary, around which norm-balls then are, or without one
    of each mesh, in a scene that `scene.search` found. InputError also where the classifier is wrong before."""

    build = partial(build_attacked, settings, size=classifier.size, device=device)
    target, seed, force = settings.target, settings.seed, settings.attack.force
    if adversary is not None:
        if adversary.pixels is not None:
            raise InputError(f"reload={settings.reload}: no attack goes on from changed pixels: leave attack= out")
        scene = adversary.scene(choose_rasterizer(settings.renderer), device)
        result = attack(classifier, scene, target, settings.attack, seed=seed, force=True)
        yield adversary.shown.name, settings.scene, result
        return
    for index, item in enumerate(settings.scene.meshes):
        named, chosen = read_object(item, settings.label, f"scene.meshes[{index}]"), settings.scene
        if settings.scene.search and not force:
            draws = generator(seed, named.mesh, "search")
            chosen = find_scene(classifier, chosen, settings.attack, partial(build, named), chosen.search, draws)
        attacked = build(named, chosen)
        with keyed("attack", vars(settings.attack)):
            result = attack(classifier, attacked, target, settings.attack, seed=seed, force=force)
        yield named.mesh, chosen, result


def build_attacked(
    settings: AttackExperimentSettings,
    item: ObjectSettings,
    scene: AttackSceneSettings,
    size: int,
    device: torch.device,
) -> Scene:
    """Build the scene of one mesh: an example per view and background, or per background if the views are shared.

    Args:
        settings: All settings of the attack.
        item: The mesh.
        scene: The settings of the scene, which replace those in `settings`.
        size: Pixels per side of the images.
        device: The device of the light and the images.

    Returns:
        The scene that is attacked.

    Raises:
        InputError: If a setting of the scene does not fit, which the message names.
    """
    options: dict[str, Any] = {"scene": scene, "renderer": settings.renderer, "device": device}
    options["attack"] = settings.attack
    options["rasterizer"] = choose_rasterizer(settings.renderer)
    with keyed("scene", vars(scene)):
        return build_scene([item], size, scene.views, shared=settings.attack.shared, **options)


def load_others(settings: AttackExperimentSettings, attacked: Classifier, device: torch.device) -> dict[str, Any]:
    """The arguments that `augment.transfer` is given. InputError as of the loaders, and for a missing class."""
    others, scene, label = settings.transfer, settings.scene, settings.label
    named = [item if isinstance(item, dict) else {"classifier": item} for item in others.classifiers]
    if unknown := next((key for item in named for key in item if key not in ("classifier", "weights")), None):
        raise InputError(f"transfer.classifiers: {unknown} is not known: give names, or {{classifier, weights}}")
    classifiers = [load_network(str(item.get("classifier")), item.get("weights")).to(device) for item in named]
    items = [*read_objects(others.meshes, label, "transfer.meshes").values()]
    for network, name in [*((other, label) for other in classifiers), *((attacked, item.label) for item in items)]:
        network.label(name)  # before anything is attacked
    objects = [on_ground(load_object(item, scene.vertices), scene.ground) for item in items]
    arguments = {"classifiers": classifiers, "azimuths": others.azimuths, "objects": objects}
    return {name: argument for name, argument in arguments.items() if argument}


def overrides(scene: AttackSceneSettings, before: AttackSceneSettings) -> str:
    """The arguments of the command line for a scene that was found in place of another."""
    names = ("polar", "azimuth", "width", "fov", "backgrounds", "light", "exposure")
    changed = (name for name in names if getattr(scene, name) != getattr(before, name))
    return " ".join(shlex.quote(f"scene.{name}={getattr(scene, name)}") for name in changed)


def format_reloaded(
    adversary: Adversary, images: Tensor, classifier: Classifier, settings: AttackSettings, seed: int
) -> str:
    """A line per view: how images (V, 3, size, size) that were rendered anew are classified, also with noise."""
    model = preprocessed_model(settings, classifier)
    logits = logits_of(model, images[None], len(images))
    predicted = logits.argmax(2)
    goal = Goal(torch.full_like(predicted, NO_CLASS), predicted)  # to be classified as without noise
    same = fooled_in_views(model, images[None], predicted, torch.zeros(1).long(), goal, settings, seed)
    largest = 255 * (images - adversary.images.to(images)).abs().flatten(1).amax(1)
    rows = zip(*predictions(logits[0], classifier.classes).values(), same[0].tolist(), largest.tolist(), strict=True)
    noise = {True: ", and so with a sensor's noise", False: ", but not always with a sensor's noise"}
    return "\n".join(
        f"view {view}: {adversary.shown.label} is classified as {name} ({confidence:.1%})"
        f"{noise[steady] if settings.sensor_noise else ''}; "
        f"values differ from the saved image's by {difference:.3g}/255 at most"
        for view, (name, confidence, steady, difference) in enumerate(rows)
    )
