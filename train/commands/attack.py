"""pnb-attack: attack each mesh of a scene, or continue from a saved adversary.

An adversary is an attacked scene that the classifier misclassifies. Its files can
be loaded again with reload=FOLDER.
"""

import shlex
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple
from warnings import catch_warnings, filterwarnings

import torch
from jaxtyping import Float
from torch import Tensor

from augment.attack_settings import AttackSettings
from augment.attacks.adversary import Adversary, reload
from augment.attacks.attack import attack
from augment.attacks.checks import check, require_transferable, success_by_radius, transfer
from augment.attacks.files import require_renderers, save
from augment.attacks.find_scene import find_scene
from augment.attacks.objective import NO_CLASS, Criterion, Objective, preprocessed_model
from augment.attacks.result import ZERO_GRADIENT, AttackResult, predictions, warnings
from augment.classifier import Classifier
from augment.network import compute_outputs
from augment.random_streams import generator
from augment.scene.build import build_scene
from augment.scene.objects import SceneObject, add_table, load_object
from augment.scene.scene import Scene
from augment.settings import ObjectSettings
from renderer.errors import InputError
from renderer.visibility import Rasterizer
from train.checkpoints import load_chosen, load_network
from train.class_names import class_name, class_of_meshes
from train.command_settings import AttackExperimentSettings, AttackSceneSettings
from train.device import choose_device, choose_rasterizer
from train.results.attack_tables import (
    FIGURE,
    TABLE,
    TRANSFERS,
    Sweep,
    format_attack,
    format_sweep,
    write_sweeps,
    write_transfers,
)
from train.results.overwrite import remove_attack, require_replaceable
from train.results.relit import MODELED, RELIT, attack_folder
from train.results.tables import Table
from train.run_config import write_config
from train.run_folder import sole_writer
from train.settings import published, read_object, read_objects
from train.system import command_line, is_verbose, shortened
from train.user_errors import keyed, keys_of, writable_folder

# Warnings about at most 3 unreadable files are printed if --verbose is not set.
MAX_UNREADABLE = 3
# The search for a scene in which a mesh is recognized may change these settings.
SEARCHED_SETTINGS = ("polar", "azimuth", "width", "fov", "backgrounds", "light", "exposure")


class MeshAttack(NamedTuple):
    """Attack on one mesh.

    Attributes:
        name: File of the mesh, or name of the generated solid.
        scene: Settings of the attacked scene.
        result: Result of the attack.
    """

    name: str
    scene: AttackSceneSettings
    result: AttackResult


@dataclass
class Outcome:
    """Text and numbers that pnb-attack prints about the attack on one mesh.

    Attributes:
        name: Name of the mesh.
        heading: Sentence that says whether the attack succeeded.
        details: Lines about other results.
        success_count: Number of examples that were classified correctly before
            the attack, and for which the attack succeeded.
        correct_count: Number of examples that were classified correctly before
            the attack.
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
    """Classifiers, views and objects other than the attacked ones.

    pnb-attack tests whether successful attacks also succeed with each of them.

    Attributes:
        classifiers: Other classifiers.
        azimuths: Angles in degrees. The cameras are rotated about the vertical
            axis by each of them.
        objects: Objects that replace the attacked object.
    """

    classifiers: Sequence[Classifier] = ()
    azimuths: Sequence[float] = ()
    objects: Sequence[SceneObject] = ()

    def __bool__(self) -> bool:
        """Return whether there is any classifier, azimuth or object."""
        return bool(self.classifiers or self.azimuths or self.objects)

    def transfer(self, result: AttackResult) -> list[dict[str, Any]]:
        """Test whether the successful attacks of a result also succeed with each target."""
        return transfer(
            result,
            classifiers=self.classifiers,
            azimuths=self.azimuths,
            objects=self.objects,
        )


def run(settings: AttackExperimentSettings) -> None:
    """Run pnb-attack: attack meshes, write the results, and print a summary.

    If the settings name photographs, their lighting is attacked instead. With
    `settings.reload`, the predictions for a saved adversary are printed, and
    the attack, if there is one, starts at this adversary.
    """
    if settings.attack.relighting is not None:
        _attack_photographs(settings)
        return
    _require_attack_settings(settings)
    adversary = reload(settings.reload) if settings.reload else None
    if adversary is None:
        with keyed("attack"):
            settings.attack.require_parameters()
    device = choose_device(settings.device)
    with keyed(name="network"):
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
        remove_attack(out)
        mesh_attacks = attacks(settings, classifier, device, adversary)
        with catch_warnings():
            if settings.attack.checks is not False:
                # The checks say this for each mesh.
                filterwarnings("ignore", ZERO_GRADIENT)
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
    """Create the rasterizer that the settings of the renderer choose."""
    with keyed(**keys_of("renderer", settings.renderer)):
        return choose_rasterizer(settings.renderer)


def _require_attack_settings(settings: AttackExperimentSettings) -> None:
    """Check the settings of the transfer and of the renderers before any file is read."""
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
    """Run the attacks on several meshes, and write each result to its own folder.

    The sweeps are by the name of the folder, and empty if `attack.radius_scales` is.
    """
    sweeps: dict[str, Sweep] = {}
    outcomes = []
    for index, mesh_attack in enumerate(mesh_attacks):
        # The name of a solid has colons, which Windows does not allow in file names.
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
    """Check the result of the attack on one mesh, and write it to a folder."""
    name = mesh_attack.name
    result = mesh_attack.result
    is_correct_before = result.clean_correct
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
        heading, *more_lines = format_attack(name, result, checks, lines)
        details += [*more_lines, f"images, adversaries and numbers: {folder}"]
    else:
        (heading,) = format_attack(name, result, None)
        texts = warnings(checks) if checks else []
        details += [f"warning about {name}: {text}" for text in texts]
    if targets:
        table = write_transfers(targets.transfer(result), folder / TRANSFERS)
        details += table.splitlines()
    return Outcome(
        name,
        heading,
        details,
        success_count=int(result.success[is_correct_before].sum()),
        correct_count=int(is_correct_before.sum()),
        example_count=len(is_correct_before),
    )


def format_outcomes(outcomes: Sequence[Outcome]) -> list[str]:
    """Format the summary that pnb-attack prints about the attacks on all meshes.

    Several meshes get a number of successes and a table. Details follow in any case.
    """
    (first, *others) = outcomes
    lines = [first.heading]
    if others:
        success_count = sum(outcome.success_count for outcome in outcomes)
        correct_count = sum(outcome.correct_count for outcome in outcomes)
        counts = f"{success_count} of {correct_count} examples that were correct before"
        lines = [f"{len(outcomes)} meshes: success on {counts}"]
        header = ["mesh", "examples", "correct before", "success"]
        rows = [
            [item.name, item.example_count, item.correct_count, item.success_count]
            for item in outcomes
        ]
        lines += str(Table("", header, rows)).splitlines()
    for outcome in outcomes:
        lines += outcome.details
    return lines


def attacks(
    settings: AttackExperimentSettings,
    classifier: Classifier,
    device: torch.device,
    adversary: Adversary | None = None,
) -> Iterator[MeshAttack]:
    """Attack each mesh of the settings, or the scene of a saved adversary.

    If a mesh is misclassified in its scene, a search looks for another scene in which it is
    recognized. This scene is then attacked. The values of an adversary are the start of its attack
    and the centers of the norm-balls.
    """
    if adversary is not None:
        yield _attack_adversary(settings, classifier, device, adversary)
        return
    for index, item in enumerate(settings.meshes):
        key = f"meshes[{index}]"
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
    """Attack the scene of a saved adversary, starting at its attacked values.

    An adversary with changed pixels instead of a changed scene raises InputError.
    """
    if adversary.pixels is not None:
        raise InputError(
            f"reload={settings.reload} is an adversary with changed pixels, from which an attack "
            "cannot continue: remove attack=",
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
    """Attack one mesh in the scene of the settings, or in a scene that a search finds.

    The search looks for a scene in which the classifier recognizes the mesh. There is no search if
    `scene.search` is 0, or if `attack.force` allows to attack a misclassified mesh.
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
    """Build the scene in which one mesh is attacked.

    With `attack.shared`, one attack must succeed in all views, so the scene has
    one example for each background. Otherwise it has one example for each pair
    of a view and a background.
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
    """Load the other classifiers and meshes with which successful attacks are tested."""
    label = ""
    if settings.transfer.networks or settings.transfer.meshes:
        # The class is compared by name, because its index may differ in other classifiers.
        if settings.label is None:
            label = class_of_meshes(settings.meshes, attacked.classes, "meshes")
        else:
            label = class_name(attacked.classes, settings.label, "label")
    classifiers = []
    for item in settings.transfer.networks:
        classifier = _load_classifier(item, settings.trust).to(device)
        # `label` raises an InputError if the classifier lacks the class.
        classifier.label(label)
        classifiers.append(classifier)
    objects = []
    meshes = read_objects(settings.transfer.meshes, label, "transfer.meshes")
    for mesh in meshes.values():
        # `label` raises an InputError if the classifier lacks the class.
        attacked.label(mesh.label)
        loaded = load_object(mesh, settings.scene.vertices)
        objects.append(add_table(loaded, settings.scene.ground))
    return TransferTargets(classifiers, settings.transfer.azimuths, objects)


def _load_classifier(item: Any, trust: bool) -> Classifier:
    """Load one classifier that the setting `transfer.networks` names.

    `item` is a name, or has the keys "network" and "weights".
    """
    values = item if isinstance(item, dict) else {"network": item}
    for key in values:
        if key not in ("network", "weights"):
            raise InputError(
                f"transfer.networks has an entry with the unknown key {key}: "
                "give the name of a network, or {network: NAME, weights: FILE}",
            )
    with keyed(name="transfer.networks", weights="transfer.networks: weights"):
        name = str(values.get("network"))
        return load_network(name, values.get("weights"), trust_code=trust)


def overrides(scene: AttackSceneSettings, before: AttackSceneSettings) -> str:
    """Write the settings that the search for a scene changed, such as "scene.polar=80.0"."""
    words = []
    for name in SEARCHED_SETTINGS:
        value = getattr(scene, name)
        if value != getattr(before, name):
            words.append(shlex.quote(f"scene.{name}={value}"))
    return " ".join(words)


def format_reloaded(
    adversary: Adversary,
    images: Float[Tensor, "V 3 size size"],
    classifier: Classifier,
    settings: AttackSettings,
    seed: int,
) -> list[str]:
    """Classify the images of a reloaded adversary, and describe the predictions.

    The images are rendered again, in [0, 1]. Each line has the prediction, whether noise changes
    it, and the largest difference from the saved image.
    """
    # `images[None]` is one example with V views. Logits have the shape (1, V, classes).
    logits = compute_outputs(preprocessed_model(settings, classifier), images[None], len(images))
    predicted = logits.argmax(2)
    # The target class of the "attack" is `predicted`. `fooled_in_views` then tests whether
    # the images are still classified as `predicted` when there is noise.
    criterion = Criterion(source=torch.full_like(predicted, NO_CLASS), target=predicted)
    objective = Objective(classifier, criterion, settings, seed)
    example = torch.zeros(1, dtype=torch.int64)
    is_same_with_noise = objective.fooled_in_views(images[None], predicted, example)
    saved_images = adversary.images_in_views.to(images)
    max_differences = (images - saved_images).abs().flatten(1).amax(1)
    named = predictions(logits[0], classifier.classes)
    lines = []
    for view in range(len(images)):
        predicted_name = named["predicted"][view]
        confidence = named["confidence"][view]
        line = f"view {view}: {adversary.shown.label} is classified as {predicted_name}"
        line += f" ({confidence:.1%})"
        if settings.sensor_noise:
            same = ", and so with a sensor's noise"
            different = ", but not always with a sensor's noise"
            line += same if is_same_with_noise[0, view] else different
        difference = 255 * float(max_differences[view])
        line += f"; values differ from the saved image's by {difference:.3g}/255 at most"
        lines.append(line)
    return lines


def _attack_photographs(settings: AttackExperimentSettings) -> None:
    """Attack a network by the light of a projector on photographs, and print the results."""
    relighting = settings.attack.relighting
    if relighting is None or settings.unlabeled is None:
        raise InputError(
            "attack=relighting needs unlabeled=FOLDER, and unlabeled=FOLDER needs "
            "attack=relighting: set both"
        )
    device = choose_device(settings.device)
    with keyed(name="network"):
        classifier = load_chosen(settings).to(device)
    out = writable_folder(settings.out, "out")
    require_replaceable(out, "out", settings.overwrite)
    with sole_writer("out", out):
        remove_attack(out)
        with keyed("unlabeled"):
            scores = attack_folder(
                classifier,
                published(Path(settings.unlabeled)),
                relighting,
                out,
                sensor_noise=settings.attack.sensor_noise,
                batch_size=settings.attack.batch_size,
                seed=settings.seed,
            )
        write_config(out, settings, command=command_line("attack"))
    print(f"{scores.summary_table()}\n")
    print(f"{MODELED}\n")
    unreadable = [f"warning: {path} cannot be read" for path in scores.unreadable]
    for line in shortened(unreadable, MAX_UNREADABLE):
        print(line)
    print(f"predictions and pictures: {out / RELIT}")
