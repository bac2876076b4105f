"""The attack command: its settings, which are the schema of conf/attack.yaml, and the run over meshes."""

import re
import shlex
import shutil
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from augment.attacks.adversary import Adversary, reload
from augment.attacks.attack import (
    AttackResult,
    AttackSettings,
    attack,
    fooled_in_views,
    logits_of,
    predictions,
)
from augment.attacks.descent import Goal
from augment.attacks.evaluate import check, require_transferable, success_by_radius, transfer
from augment.attacks.files import LINES, require_renderers, save
from augment.attacks.search import find_scene
from augment.build import LOCAL_LIGHT_SETTINGS, LampsSettings, RendererSettings, SceneSettings, build_scene
from augment.classifiers import Classifier, load_classifier
from augment.losses import NO_CLASS
from augment.objects import ObjectSettings, load_object, on_ground
from augment.random_streams import generator
from augment.scene import Scene
from renderer.camera import MOST_VIEWS
from renderer.errors import FACTOR, InputError, require_range
from train.device import choose_device
from train.errors import writable_folder
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
from train.results import require_replaceable
from train.run_folder import sole_writer, write_config
from train.settings import LARGEST_SEED, chosen_rasterizer, keyed, program, read_object

LAMP_POWER = 2.0  # of the default lamps whose positions alone are attacked


@dataclass
class AttackCommandSettings(AttackSettings):
    """conf/attack.yaml says what each key does."""

    shared: bool = False
    force: bool = False
    checks: bool = True
    radius_scales: list[float] = field(default_factory=list)
    verify: str | None = "reload"

    def __post_init__(self) -> None:
        super().__post_init__()
        require_renderers(self.renderers)
        for scale in self.radius_scales:
            require_range("radius_scales", scale, 1 / FACTOR, FACTOR)

    @property
    def renderers(self) -> list[str]:
        """Those of `verify`."""
        return self.verify.split("+") if self.verify else []


@dataclass
class AttackSceneSettings(SceneSettings):
    """search: how many cameras to try where the classifier is wrong; see `augment.attacks.search`."""

    views: int = 1
    search: int = 10

    def __post_init__(self) -> None:
        if not self.meshes or not self.backgrounds:
            raise InputError("meshes and backgrounds must not be empty: name one mesh and one background")
        require_range("search", self.search, 0, MOST_VIEWS)
        super().__post_init__()


@dataclass
class TransferSettings:
    """Where else adversaries are shown; conf/attack.yaml says what each key does."""

    classifiers: list[Any] = field(default_factory=list)
    azimuths: list[float] = field(default_factory=list)
    meshes: list[Any] = field(default_factory=list)

    def __post_init__(self) -> None:
        for angle in self.azimuths:
            require_range("transfer.azimuths", angle, -360, 360)


@dataclass
class AttackExperimentSettings:
    """One attack on one classifier; conf/attack.yaml says what each key does. A projector or lamps that are attacked
    stand in the scene, where it names none with their defaults; an attacked pose sets `renderer.silhouettes`."""

    classifier: str = "efficientnet_lite0"
    weights: str | None = None
    label: str = "orange"
    target: Any = None
    seed: int = 0
    out: str = ""
    reload: str | None = None
    overwrite: bool = False
    device: str = "auto"
    attack: AttackCommandSettings = field(default_factory=AttackCommandSettings)
    transfer: TransferSettings = field(default_factory=TransferSettings)
    scene: AttackSceneSettings = field(default_factory=AttackSceneSettings)
    renderer: RendererSettings = field(default_factory=lambda: RendererSettings(shadows=True))

    def __post_init__(self) -> None:
        require_range("seed", self.seed, 0, LARGEST_SEED)
        names = self.target if isinstance(self.target, list) else [self.target]
        if any(isinstance(name, dict | list) for name in names):
            raise InputError("target: give a class, least_likely, or a list of classes, one per view")
        if isinstance(self.target, int | float):  # a class whose name is a number
            self.target = str(self.target)
        require_transferable(self.attack.parameters, self.transfer.azimuths, self.transfer.meshes)
        for name, kind in LOCAL_LIGHT_SETTINGS.items():
            if getattr(self.attack, name) is not None and getattr(self.scene, name) is None:
                setattr(self.scene, name, kind())
        if self.attack.pose is not None:
            self.renderer.silhouettes = True
        if self.attack.positions is not None and self.scene.lamps is None:
            self.scene.lamps = LampsSettings(start=LAMP_POWER)


def run(settings: AttackExperimentSettings) -> None:
    """Attack each mesh or the reloaded adversary, write what came of it, and print a summary."""
    adversary = reload(settings.reload) if settings.reload else None
    if adversary is None:
        settings.attack.require_parameters()
    device = choose_device(settings.device)
    classifier = load_classifier(settings.classifier, settings.weights).to(device)
    if adversary is not None:
        images = adversary.render(chosen_rasterizer(settings.renderer)).to(device)
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
        write_config(out, settings, command=shlex.join([*program("attack"), *sys.argv[1:]]))


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
        scene = adversary.scene(chosen_rasterizer(settings.renderer), device)
        result = attack(classifier, scene, target, settings.attack, seed=seed, force=True)
        yield adversary.shown.name, settings.scene, result
        return
    for index, item in enumerate(settings.scene.meshes):
        named, chosen = read_object(item, settings.label, index), settings.scene
        if settings.scene.search and not force:
            draws = generator(seed, named.mesh, "search")
            chosen = find_scene(classifier, chosen, settings.attack, partial(build, named), chosen.search, draws)
        attacked = build(named, chosen)
        try:
            result = attack(classifier, attacked, target, settings.attack, seed=seed, force=force)
        except InputError as error:  # which names arguments of Python
            raise InputError(re.sub(r"(force|shared)=True", r"attack.\1=true", str(error))) from error
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
    options["rasterizer"] = chosen_rasterizer(settings.renderer)
    with keyed("scene", vars(scene)):
        return build_scene([item], size, scene.views, shared=settings.attack.shared, **options)


def load_others(settings: AttackExperimentSettings, attacked: Classifier, device: torch.device) -> dict[str, Any]:
    """The arguments that `augment.transfer` is given. InputError as of the loaders, and for a missing class."""
    others, scene, label = settings.transfer, settings.scene, settings.label
    named = [item if isinstance(item, dict) else {"classifier": item} for item in others.classifiers]
    if unknown := next((key for item in named for key in item if key not in ("classifier", "weights")), None):
        raise InputError(f"transfer.classifiers: {unknown} is not known: give names, or {{classifier, weights}}")
    classifiers = [load_classifier(str(item.get("classifier")), item.get("weights")).to(device) for item in named]
    items = [read_object(item, label, index, "transfer.meshes") for index, item in enumerate(others.meshes)]
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
    model = settings.preprocessed_model(classifier)
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
