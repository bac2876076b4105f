"""The attack command: attack each mesh of a scene, or a saved adversary."""

import shlex
import shutil
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from augment.attack_settings import AttackSettings
from augment.attacks.adversary import Adversary, reload
from augment.attacks.attack import AttackResult, attack, fooled_in_views, logits_of, predictions
from augment.attacks.attack_files import LINES, require_renderers, save
from augment.attacks.checks import (
    check,
    require_transferable,
    success_by_radius,
    transfer,
    warnings,
)
from augment.attacks.descent import Criterion
from augment.attacks.eot import preprocessed_model
from augment.attacks.search import find_scene
from augment.classifiers import Classifier
from augment.losses import NO_CLASS
from augment.random_streams import generator
from augment.scene.build import build_scene
from augment.scene.objects import SceneObject, add_table, load_object
from augment.scene.scene import Scene
from augment.settings import ObjectSettings
from renderer.errors import InputError
from renderer.visibility.rasterizers import Rasterizer
from train.class_names import class_name, class_of_meshes
from train.command import command_line
from train.command_settings import AttackExperimentSettings, AttackSceneSettings
from train.commands import attack_photographs
from train.evaluation.tables import Table
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
from train.report.results import require_replaceable
from train.runs.run_config import write_config
from train.runs.run_lock import sole_writer
from train.runs.saved_networks import load_chosen, load_network
from train.settings import read_object, read_objects
from train.system.device import choose_device, choose_rasterizer
from train.system.user_errors import keyed, keys_of, writable_folder
from train.system.verbosity import is_verbose, shortened

# Settings that `find_scene` may change, in the order in which they are printed.
SEARCHED_SETTINGS = ("polar", "azimuth", "width", "fov", "backgrounds", "light", "exposure")


class MeshAttack(NamedTuple):
    """The attack on one mesh.

    Attributes:
        name: Name of the mesh: its file or its solid.
        scene: Settings of the attacked scene.
        result: Result of `nb.attack`.
    """

    name: str
    scene: AttackSceneSettings
    result: AttackResult


@dataclass
class Outcome:
    """Lines and numbers that are printed about the attack on one mesh.

    Attributes:
        name: Name of the mesh.
        heading: Sentence with the success.
        details: Lines of further results.
        success_count: Number of examples with a success, of those that were
            correct before.
        correct_count: Number of examples that were correct before.
        example_count: Number of all examples.
    """

    name: str
    heading: str
    details: list[str]
    success_count: int
    correct_count: int
    example_count: int


@dataclass(frozen=True)
class TransferTargets:
    """Other classifiers, views and objects to which successful adversaries are shown.

    Attributes:
        classifiers: Other classifiers.
        azimuths: Angles in degrees by which the cameras are turned about the
            vertical.
        objects: Objects that replace the attacked one.
    """

    classifiers: Sequence[Classifier] = ()
    azimuths: Sequence[float] = ()
    objects: Sequence[SceneObject] = ()

    def __bool__(self) -> bool:
        """Return whether there is anything to transfer to."""
        return bool(self.classifiers or self.azimuths or self.objects)

    def transfer(self, result: AttackResult) -> list[dict[str, Any]]:
        """Show the adversaries of a result to all targets, see `nb.transfer`."""
        return transfer(
            result,
            classifiers=self.classifiers,
            azimuths=self.azimuths,
            objects=self.objects,
        )


def run(settings: AttackExperimentSettings) -> None:
    """Attack each mesh or the reloaded adversary, write the results, and print a summary.

    Without an attack, print how the reloaded adversary is classified.

    Args:
        settings: Settings of pnb-attack.

    Raises:
        InputError: If a setting or an input file is wrong, or if a classifier
            misclassifies a mesh before the attack.
    """
    if settings.attack.relighting is not None:
        attack_photographs.run(settings)
        return
    _require_attack_settings(settings)
    adversary = reload(settings.reload) if settings.reload else None
    if adversary is None:
        with keyed("attack"):
            settings.attack.require_parameters()
    device = choose_device(settings.device)
    with keyed(name="classifier"):
        classifier = load_chosen(settings).to(device)
    if adversary is not None:
        images = adversary.render_views(_start_rasterizer(settings)).to(device)
        views = format_reloaded(adversary, images, classifier, settings.attack, settings.seed)
        print("\n".join(shortened(views)))
        if not settings.attack.parameters:
            return
    targets = load_targets(settings, classifier, device)
    out = writable_folder(settings.out, "out")
    require_replaceable(out, "out", settings.overwrite)
    with sole_writer("out", out):
        _remove_adversaries(out)
        mesh_attacks = attacks(settings, classifier, device, adversary)
        outcomes, sweeps = _write_attacks(mesh_attacks, out, settings, targets)
        if not is_verbose():
            print("\n".join(shortened(format_outcomes(outcomes))))
        if sweeps:
            norms = {name: steps.norm for name, steps in settings.attack.parameters.items()}
            write_sweeps(sweeps, norms, out)
            if is_verbose():
                print(f"success against radius: {out / TABLE} and {out / FIGURE}")
        write_config(out, settings, command=command_line("attack"))
    print(f"images, adversaries and numbers: {out}")


def _start_rasterizer(settings: AttackExperimentSettings) -> Rasterizer:
    """Start the rasterizer that the settings name."""
    with keyed(**keys_of("renderer", settings.renderer)):
        return choose_rasterizer(settings.renderer)


def _require_attack_settings(settings: AttackExperimentSettings) -> None:
    """Check the settings that can be checked before any file or classifier is read."""
    with keyed("transfer", **keys_of("transfer", settings.transfer)):
        require_transferable(
            settings.attack.parameters,
            settings.transfer.azimuths,
            settings.transfer.meshes,
        )
    with keyed("attack", **keys_of("attack", settings.attack)):
        require_renderers(settings.attack.renderers)


def _write_attacks(
    mesh_attacks: Iterable[MeshAttack],
    out: Path,
    settings: AttackExperimentSettings,
    targets: TransferTargets,
) -> tuple[list[Outcome], dict[str, Sweep]]:
    """Attack each mesh, and write the result to a folder of its own.

    Args:
        mesh_attacks: Attacks, each of which runs when it is asked for.
        out: Folder that contains the folders of the meshes.
        settings: Settings of pnb-attack.
        targets: Other classifiers, views and meshes that see the adversaries.

    Returns:
        Outcome of each attack, and the success at each radius by the name of the
        folder. The second is empty if `attack.radius_scales` is empty.
    """
    sweeps: dict[str, Sweep] = {}
    outcomes = []
    for index, mesh_attack in enumerate(mesh_attacks):
        # Windows allows no colon in the name of a folder.
        stem = Path(mesh_attack.name.replace(":", "_")).stem
        folder = out / f"{index}_{stem}"
        outcome = _write_attack(mesh_attack, folder, settings, targets)
        if settings.attack.radius_scales:
            sweep = success_by_radius(mesh_attack.result, settings.attack.radius_scales)
            sweeps[folder.name] = sweep
            outcome.details += format_sweep(sweep).splitlines()
        outcomes.append(outcome)
        if is_verbose():
            print("\n".join([outcome.heading, *outcome.details, ""]))
    return outcomes, sweeps


def _write_attack(
    mesh_attack: MeshAttack,
    folder: Path,
    settings: AttackExperimentSettings,
    targets: TransferTargets,
) -> Outcome:
    """Check the attack on one mesh, and write its files into a folder.

    Args:
        mesh_attack: The attack.
        folder: Folder of the files.
        settings: Settings of pnb-attack.
        targets: Classifiers, views and objects to which the adversaries are
            transferred.

    Returns:
        The lines to print and the numbers of successes. With --verbose, the
        lines have the results of the checks, too.
    """
    name = mesh_attack.name
    result = mesh_attack.result
    clean = result.clean_correct
    details = []
    if mesh_attack.scene != settings.scene:
        changes = overrides(mesh_attack.scene, settings.scene)
        details.append(f"{name} is misclassified in the given scene, but not with {changes}")
    has_checks = settings.attack.checks
    if has_checks is None:
        has_checks = result.settings.uses_gradients
    checks = check(result) if has_checks else None
    lines = save(result, folder, checks, settings.attack.renderers)
    if is_verbose():
        heading, *found = format_attack(name, result, checks, lines)
        details += [*found, f"images, adversaries and numbers: {folder}"]
    else:
        (heading,) = format_attack(name, result, None)
        doubts = warnings(checks) if checks else []
        details += [f"warning about {name}: {doubt}" for doubt in doubts]
    if targets:
        table = write_transfers(targets.transfer(result), folder / TRANSFERS)
        details += table.splitlines()
    return Outcome(
        name,
        heading,
        details,
        success_count=int(result.success[clean].sum()),
        correct_count=int(clean.sum()),
        example_count=len(clean),
    )


def format_outcomes(outcomes: Sequence[Outcome]) -> list[str]:
    """Write the outcomes of several meshes.

    Args:
        outcomes: Outcome for each mesh.

    Returns:
        Lines. One mesh has its sentence. Several meshes have their number of
        successes and a table with a row for each. The details follow.
    """
    (first, *others) = outcomes
    lines = [first.heading]
    if others:
        successes = sum(outcome.success_count for outcome in outcomes)
        correct = sum(outcome.correct_count for outcome in outcomes)
        counted = f"{successes} of {correct} examples that were correct before"
        lines = [f"{len(outcomes)} meshes: success on {counted}"]
        header = ["mesh", "examples", "correct before", "success"]
        rows = [
            [item.name, item.example_count, item.correct_count, item.success_count]
            for item in outcomes
        ]
        lines += str(Table("", header, rows)).splitlines()
    for outcome in outcomes:
        lines += outcome.details
    return lines


def _remove_adversaries(out: Path) -> None:
    """Remove the files of an earlier attack from a folder.

    Otherwise a report would show its adversaries among the new ones.
    """
    for lines in out.glob(f"*/{LINES}"):
        for example in lines.parent.glob("example_*"):
            if example.is_dir():
                shutil.rmtree(example)
            else:
                example.unlink()
        lines.unlink()
        lines.with_name(TRANSFERS).unlink(missing_ok=True)
    for name in (TABLE, FIGURE):
        (out / name).unlink(missing_ok=True)


def attacks(
    settings: AttackExperimentSettings,
    classifier: Classifier,
    device: torch.device,
    adversary: Adversary | None = None,
) -> Iterator[MeshAttack]:
    """Attack a saved adversary or, without one, each mesh of the scene.

    A mesh that is misclassified in the given scene is attacked in the scene
    that `scene.search` finds.

    Args:
        settings: Settings of pnb-attack.
        classifier: Classifier to attack.
        device: Device of the light and the images.
        adversary: Adversary at which the attack starts, and around which its
            norm-balls lie.

    Yields:
        Attack on each mesh.

    Raises:
        InputError: If a mesh is misclassified before the attack, or if the
            adversary consists of changed pixels.
    """
    if adversary is not None:
        yield _attack_adversary(settings, classifier, device, adversary)
        return
    for index, item in enumerate(settings.scene.meshes):
        key = f"scene.meshes[{index}]"
        label = "" if settings.label is None else str(settings.label)
        mesh = read_object(item, label, key)
        if not mesh.label:
            mesh.label = class_of_meshes([item], classifier.classes, key)
        mesh.label = class_name(classifier.classes, mesh.label, "label")
        yield _attack_mesh(settings, classifier, device, mesh)


def _attack_adversary(
    settings: AttackExperimentSettings,
    classifier: Classifier,
    device: torch.device,
    adversary: Adversary,
) -> MeshAttack:
    """Attack the scene of a saved adversary.

    Raises:
        InputError: If the adversary consists of changed pixels, which have no
            scene.
    """
    if adversary.pixels is not None:
        raise InputError(
            f"reload={settings.reload}: "
            "an attack cannot continue from changed pixels: "
            "leave attack= out",
        )
    scene = adversary.scene(_start_rasterizer(settings), device)
    result = attack(
        classifier,
        scene,
        settings.target,
        settings.attack,
        seed=settings.seed,
        force=True,
    )
    return MeshAttack(adversary.shown.name, settings.scene, result)


def _attack_mesh(
    settings: AttackExperimentSettings,
    classifier: Classifier,
    device: torch.device,
    mesh: ObjectSettings,
) -> MeshAttack:
    """Attack one mesh in the given scene, or in a scene that a search finds.

    The search looks for a scene in which the classifier recognizes the mesh. It
    is left out if `attack.force` attacks a misclassified mesh, too.
    """
    build = partial(build_attacked, settings, mesh, size=classifier.size, device=device)
    scene_settings = settings.scene
    if scene_settings.search and not settings.attack.force:
        scene_settings = find_scene(
            classifier,
            scene_settings,
            settings.attack,
            build,
            scene_settings.search,
            generator(settings.seed, mesh.mesh, "search"),
        )
    scene = build(scene_settings)
    with keyed("attack", **keys_of("attack", settings.attack)):
        result = attack(
            classifier,
            scene,
            settings.target,
            settings.attack,
            seed=settings.seed,
            force=settings.attack.force,
        )
    return MeshAttack(mesh.mesh, scene_settings, result)


def build_attacked(
    settings: AttackExperimentSettings,
    item: ObjectSettings,
    scene: AttackSceneSettings,
    size: int,
    device: torch.device,
) -> Scene:
    """Build the scene of one mesh.

    If the views are shared, the scene has an example per background. Otherwise
    it has an example per view and background.

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
    rasterizer = _start_rasterizer(settings)
    with keyed("scene", **keys_of("scene", scene)):
        return build_scene(
            [item],
            size,
            scene.views,
            shared=settings.attack.shared,
            scene=scene,
            renderer=settings.renderer,
            attack=settings.attack,
            rasterizer=rasterizer,
            device=device,
        )


def load_targets(
    settings: AttackExperimentSettings,
    attacked: Classifier,
    device: torch.device,
) -> TransferTargets:
    """Load the classifiers and the meshes to which adversaries are transferred.

    Args:
        settings: Settings of pnb-attack.
        attacked: Classifier that is attacked. It classifies the other meshes.
        device: Device of the other classifiers.

    Returns:
        Targets of the transfer, which may be none.

    Raises:
        InputError: If a classifier or a mesh cannot be loaded, or if a
            classifier lacks a class that it is asked for.
    """
    label = ""
    if settings.transfer.classifiers or settings.transfer.meshes:
        # Another classifier may have the class at another index.
        if settings.label is None:
            label = class_of_meshes(settings.scene.meshes, attacked.classes, "scene.meshes")
        else:
            label = class_name(attacked.classes, settings.label, "label")
    classifiers = []
    for item in settings.transfer.classifiers:
        classifier = _load_classifier(item).to(device)
        # A missing class is an error before anything is attacked.
        classifier.label(label)
        classifiers.append(classifier)
    objects = []
    meshes = read_objects(settings.transfer.meshes, label, "transfer.meshes")
    for mesh in meshes.values():
        attacked.label(mesh.label)
        loaded = load_object(mesh, settings.scene.vertices)
        objects.append(add_table(loaded, settings.scene.ground))
    return TransferTargets(classifiers, settings.transfer.azimuths, objects)


def _load_classifier(item: Any) -> Classifier:
    """Load an item of `transfer.classifiers`: a name, or a mapping {classifier, weights}."""
    named = item if isinstance(item, dict) else {"classifier": item}
    for key in named:
        if key not in ("classifier", "weights"):
            raise InputError(
                f"transfer.classifiers: {key} is not known: give names, or {{classifier, weights}}",
            )
    with keyed(name="transfer.classifiers", weights="transfer.classifiers: weights"):
        return load_network(str(named.get("classifier")), named.get("weights"))


def overrides(scene: AttackSceneSettings, before: AttackSceneSettings) -> str:
    """Write the words of a command line that turn one scene into another.

    Args:
        scene: Settings of the scene that a search found.
        before: Settings of the scene that was given.

    Returns:
        Words such as "scene.polar=80.0 scene.exposure=2.0".
    """
    words = []
    for name in SEARCHED_SETTINGS:
        value = getattr(scene, name)
        if value != getattr(before, name):
            words.append(shlex.quote(f"scene.{name}={value}"))
    return " ".join(words)


def format_reloaded(
    adversary: Adversary,
    images: Tensor,
    classifier: Classifier,
    settings: AttackSettings,
    seed: int,
) -> list[str]:
    """Say how a classifier predicts the images of a reloaded adversary.

    Args:
        adversary: Adversary with the images that were saved.
        images: Images that were rendered again, in [0, 1], shape
            (V, 3, size, size).
        classifier: Classifier of the images.
        settings: Settings of the attack, which say whether there is sensor
            noise.
        seed: Seed of the noise.

    Returns:
        A line for each view: the predicted class, whether the prediction is the
        same with sensor noise, and the largest difference from the saved image.
    """
    model = preprocessed_model(settings, classifier)
    # The views are one example, so logits and predictions have shape (1, V, ...).
    logits = logits_of(model, images[None], len(images))
    predicted = logits.argmax(2)
    # The criterion of a view is met if it is classified as without noise.
    criterion = Criterion(source=torch.full_like(predicted, NO_CLASS), target=predicted)
    is_steady = fooled_in_views(
        model,
        images[None],
        predicted,
        examples=torch.zeros(1, dtype=torch.int64),
        criterion=criterion,
        settings=settings,
        seed=seed,
    )
    differences = (images - adversary.images_in_views.to(images)).abs().flatten(1).amax(1)
    named = predictions(logits[0], classifier.classes)
    lines = []
    for view in range(len(images)):
        predicted_name = named["predicted"][view]
        confidence = named["confidence"][view]
        line = f"view {view}: {adversary.shown.label} is classified as {predicted_name}"
        line += f" ({confidence:.1%})"
        if settings.sensor_noise:
            steady = ", and so with a sensor's noise"
            unsteady = ", but not always with a sensor's noise"
            line += steady if is_steady[0, view] else unsteady
        difference = 255 * float(differences[view])
        line += f"; values differ from the saved image's by {difference:.3g}/255 at most"
        lines.append(line)
    return lines
