"""Run the audit of pnb-audit.

An audit consists of many measurements, such as the attacks on one network with
one kind of lighting. Each result is written to its own file or folder, completely
or not at all. An audit that was stopped therefore continues with the first
missing result. `train.auditing.page` then reads all results and writes the
report.

The folder of the audit has a subfolder of results for each network. The names of
the subfolders are CLASSIFIER and HARDENED.
"""

import json
import shutil
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import nullcontext, suppress
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from augment.classifier import Classifier
from augment.scene.objects import load_object
from augment.settings import ObjectSettings
from renderer.errors import InputError, keyed
from renderer.io.files import atomic_write
from renderer.light.files import UNIFORM, load_light
from renderer.mitsuba_scene import mitsuba
from train import console
from train.auditing import page
from train.auditing.lights import (
    KINDS,
    QUERIES,
    PlainViews,
    Views,
    find_plain_views,
    recognize_in_environments,
    success_by_light,
    transfer_success,
)
from train.auditing.network import (
    CLASSIFIER,
    HARDENED,
    LABORATORY,
    NORMALIZED,
    PHOTOGRAPHS,
    PLAIN,
    RECOGNIZED,
    TRANSFER,
    name_remedies,
    normalizing,
)
from train.auditing.relit import (
    RELIT_FOLDER,
    measure_photographs,
    photographs_screen,
    write_photographs_page,
)
from train.checkpoints import load_chosen, load_network
from train.class_names import class_of_meshes, require_others, with_class_name
from train.command_settings import AuditSettings, LabSettings
from train.data.photographs import find_photographs, find_unlabeled
from train.device import choose_device
from train.laboratory.laboratory import write_laboratory
from train.results.overwrite import RESULTS, require_replaceable
from train.results.page import PAGE
from train.results.scoring import Predictor, evaluate_photographs
from train.run_config import CONFIG, read_config, require_same, write_config
from train.run_folder import read_json, sole_writer, writable_folder
from train.settings import OTHER_PREFIX, published, read_objects, simplified, solid_name
from train.system import command_line

# Number of views of the meshes that are rendered in environment lighting.
VIEW_COUNT = 24
# Number of random environment lights, in addition to those that the user names.
RANDOM_LIGHT_COUNT = 8
# Number of views that are attacked with each kind of lighting.
ATTACKED_COUNT = 12
# Number of random setups of light, camera and pose that are path-traced for each
# projected pattern and each environment map.
SETUPS = 6
# Projected patterns of the path-traced renders. No training of this project uses them.
PATTERNS = ("gradient", "rings", "window", "leaves", "text", "colors")
# Number of light paths per pixel of the path-traced renders.
SPP = 48
# Generated solids that serve as hard negatives if the user names none.
HARD_NEGATIVES = (
    "solid:lemon",
    "solid:apple",
    "solid:peach",
    "solid:pear",
    "solid:sweet_pepper",
    "solid:ball",
)
NO_HARD_NEGATIVES = (
    "hard_negatives is empty, so false positives are measured on generated fruit and balls; "
    "name meshes of what the classifier may confuse with the class."
)
# Settings of pnb-audit that name the folders of test images, by the name of the images.
FOLDER_KEYS = {LABORATORY: "laboratory", PHOTOGRAPHS: "photos"}
# When a stopped audit continues, these settings may be set if they were not set before.
SETTABLE_LATER = ("hardened", "photos", "unlabeled")


def run_audit(
    settings: AuditSettings,
    networks: Mapping[str, Classifier] | None = None,
) -> page.Audited:
    """Test networks in unusual lighting, and write a report to the folder `settings.out`.

    Results that an earlier, stopped audit wrote to this folder are not measured
    again.
    """
    is_named = networks is None
    if networks is None:
        networks = load_networks(settings)
    if not settings.meshes:
        return _audit_photographs(settings, networks, is_named)
    # Caveats are sentences at the beginning of the report.
    caveats = _size_caveats(networks.values())
    if not (settings.hard_negatives or settings.laboratory):
        caveats.append(NO_HARD_NEGATIVES)
    settings = complete(settings, networks[CLASSIFIER])
    plan = _Plan(settings, networks)
    out = writable_folder(settings.out, "out")
    _require_continuable(out, settings.overwrite, is_named)
    renders = out / "renders"
    has_renders = renders.exists() and not settings.overwrite
    if LABORATORY not in plan.image_folders:
        try:
            # `mitsuba` raises an InputError if Mitsuba, which renders, is not installed.
            with nullcontext() if has_renders else mitsuba():
                plan.image_folders = {LABORATORY: renders} | plan.image_folders
        except InputError as error:
            caveats.append(f"The laboratory is left out, and hard_negatives with it ({error}).")
    caveats += _gradient_caveats(networks.values(), plan.device)
    for sentence in caveats:
        console.warning(sentence)
    with sole_writer("out", out):
        _prepare_folder(settings, out, renders)
        plan.find_views(out / CLASSIFIER)
        if plan.image_folders.get(LABORATORY) == renders:
            size = max(network.size for network in plan.networks.values())
            laboratory = laboratory_settings(settings, renders, size)
            _write_folder(
                renders,
                lambda folder: write_laboratory(replace(laboratory, out=str(folder))),
            )
        for key, network in plan.networks.items():
            plan.measure(key, out / key)
            if settings.unlabeled:
                _measure_photographs(network, settings, out / key)
        plan.score_in_normalized_light(out)
        remedies = name_remedies(plan.networks)
        names = _names(plan.networks)
        return page.write_audit_page(
            settings.label, names, remedies, plan.image_folders, out, caveats
        )


def _audit_photographs(
    settings: AuditSettings, networks: Mapping[str, Classifier], is_named: bool
) -> page.Audited:
    """Audit networks without meshes, on photographs in the light of a projector.

    Only if the settings name the networks may an audit that was stopped continue.
    """
    device = choose_device(settings.device)
    find_unlabeled(published(Path(str(settings.unlabeled))))
    out = writable_folder(settings.out, "out")
    _require_continuable(out, settings.overwrite, is_named)
    caveats = _size_caveats(networks.values())
    for network in networks.values():
        if not network.is_differentiable(torch.empty(0, device=device)):
            caveats.append(f"{network.name} has no gradients: only random search attacks it.")
    for sentence in caveats:
        console.warning(sentence)
    with sole_writer("out", out):
        _prepare_folder(settings, out, out / "renders")
        for key, network in networks.items():
            (out / key).mkdir(exist_ok=True)
            _measure_photographs(network.to(device), settings, out / key)
        names = _names(networks)
        folders = {name: out / key for key, name in names.items()}
        screen = photographs_screen(folders)
        path = write_photographs_page(screen, folders, out, caveats)
        return page.Audited(path, screen, "", {}, None)


def _measure_photographs(network: Classifier, settings: AuditSettings, results: Path) -> None:
    """Attack a network by the light of a projector on photographs, unless the results exist."""
    _write_folder(results / RELIT_FOLDER, partial(measure_photographs, network, settings))


def _names(networks: Mapping[str, Classifier]) -> dict[str, str]:
    """Choose the names of the networks in the report.

    If both networks have the same name, " (hardened)" is added to the second.
    """
    names = {key: network.name for key, network in networks.items()}
    if len(set(names.values())) < len(names):
        names[HARDENED] += " (hardened)"
    return names


class _Plan:
    """Networks, images and lighting of an audit, checked before anything is written.

    Attributes:
        label: Class whose objects are tested.
        device: Device of the networks and the renders.
        networks: Networks by the name of the subfolder for their results.
        image_folders: Folders of labeled test images: "laboratory" for
            path-traced renders, and "photographs". Each may be missing.
        environments: Names or files of environment lights.
        random_light_count: Number of random environment lights.
        views: Views that are rendered in environment lighting.
        attacked_views: Views whose lighting is attacked.
    """

    def __init__(self, settings: AuditSettings, networks: Mapping[str, Classifier]):
        self.label = settings.label
        self.device = choose_device(settings.device)
        self.networks = {key: network.to(self.device) for key, network in networks.items()}
        meshes, hard_negatives = read_meshes(settings)
        folders = {LABORATORY: settings.laboratory, PHOTOGRAPHS: settings.photos}
        self.image_folders = {
            name: published(Path(folder)) for name, folder in folders.items() if folder
        }
        items = [*meshes, *hard_negatives]
        _require_classes(self.networks.values(), items, self.image_folders, self.label)
        # Hard negatives and lights are loaded only to report a file that cannot be read
        # before the audit begins.
        objects = [load_object(item) for item in items]
        for name in settings.environments:
            load_light(name)
        self.environments = [UNIFORM, *settings.environments]
        self.random_light_count = settings.scale(RANDOM_LIGHT_COUNT)
        seed = settings.seed
        positives = objects[: len(meshes)]
        self.views = Views(positives, settings.scale(VIEW_COUNT), seed, self.device)
        self.attacked_views = Views(positives, settings.scale(ATTACKED_COUNT), seed, self.device)

    def find_views(self, results: Path) -> None:
        """Find the ordinary light and the size at which the audited network recognizes most views.

        The views of all networks then have this light and this size.
        """
        results.mkdir(exist_ok=True)
        path = results / PLAIN
        _write_json(path, _search, self.networks[CLASSIFIER], self.attacked_views)
        plain = PlainViews(**read_json(path))
        self.views = plain.apply_to(self.views)
        self.attacked_views = plain.apply_to(self.attacked_views)

    def measure(self, key: str, results: Path) -> None:
        """Test and attack one network, except for results that exist already."""
        network = self.networks[key]
        results.mkdir(exist_ok=True)
        lights = (self.environments, self.random_light_count)
        path = results / RECOGNIZED
        _write_json(path, recognize_in_environments, network, self.views, *lights)
        for kind in KINDS:
            path = results / f"{kind}.json"
            _write_json(path, success_by_light, network, self.attacked_views, kind, results)
        self._score(network, results)
        others = [other for other in self.networks.values() if other is not network]
        if others:
            path = results / TRANSFER
            _write_json(path, transfer_success, network, *others, self.attacked_views, results)

    def score_in_normalized_light(self, out: Path) -> None:
        """Score each network with the remedy "normalized light" on the test images.

        This remedy normalizes the colors of an image before the network classifies it.
        """
        for key, network in normalizing(self.networks).items():
            self._score(network, out / key)

    def _score(self, network: Classifier, results: Path) -> None:
        """Score a network on all test images, and write the scores to subfolders."""
        for name, images in self.image_folders.items():
            results.mkdir(exist_ok=True)
            predictor = Predictor(network, network.classes, network.size, self.device)
            _write_folder(results / name, partial(_evaluate, predictor, images, self.label))


def complete(settings: AuditSettings, classifier: Classifier) -> AuditSettings:
    """Fill in the class and the hard negatives if the settings leave them out.

    The class is that of the meshes. Hard negatives are only filled in if test images must be
    rendered.
    """
    label = class_of_meshes(settings.meshes, classifier.classes, "meshes", settings.label)
    negatives = [
        with_class_name(item, classifier.classes, "hard_negatives")
        for item in settings.hard_negatives
    ]
    if not (negatives or settings.laboratory):
        negatives = [
            solid for solid in HARD_NEGATIVES if simplified(solid_name(solid)) != simplified(label)
        ]
    named = read_objects(negatives, "", "hard_negatives")
    require_others(named, [label], classifier.classes)
    meshes = [with_class_name(item, classifier.classes, "meshes") for item in settings.meshes]
    return replace(settings, label=label, meshes=meshes, hard_negatives=negatives)


def load_networks(settings: AuditSettings) -> dict[str, Classifier]:
    """Load the network to audit and, if the settings name one, the hardened network.

    The keys CLASSIFIER and HARDENED also name the subfolders of their results.
    """
    classifier = load_chosen(settings)
    networks = {CLASSIFIER: classifier}
    if settings.hardened:
        with keyed(name="hardened"):
            networks[HARDENED] = load_network(settings.hardened, trust_code=settings.trust)
    return networks


def _require_classes(
    networks: Collection[Classifier],
    items: Sequence[ObjectSettings],
    folders: Mapping[str, Path],
    label: str,
) -> None:
    """Check that all networks have the classes of the meshes and of the test images."""
    labels = {item.label for item in items if not item.label.startswith(OTHER_PREFIX)}
    for network in networks:
        for name in labels:
            network.label(name)
        for name, folder in folders.items():
            with keyed(FOLDER_KEYS[name]):
                find_photographs(folder, network.classes, label)


def _size_caveats(networks: Collection[Classifier]) -> list[str]:
    """Return a sentence for the report if the networks take images of different sizes."""
    sizes = [str(network.size) for network in networks]
    if len(set(sizes)) == 1:
        return []
    listed = " and ".join(sizes)
    return [f"The networks take images of {listed} pixels, and differ by that, too."]


def _gradient_caveats(networks: Collection[Classifier], device: torch.device) -> list[str]:
    """Return a sentence for the report about each network that has no gradients on a device."""
    return [
        f"{network.name} has no gradients: random search attacks each view with {QUERIES} queries "
        "for each radius."
        for network in networks
        if not network.is_differentiable(torch.empty(0, device=device))
    ]


def _prepare_folder(settings: AuditSettings, out: Path, renders: Path) -> None:
    """Prepare the folder of an audit, and write the settings to its file config.yaml.

    With `settings.overwrite`, the results of an earlier audit are removed.
    Otherwise an earlier audit in the folder must have the same settings.
    """
    if settings.overwrite:
        networks = (CLASSIFIER, HARDENED, CLASSIFIER + NORMALIZED, HARDENED + NORMALIZED)
        (out / PAGE).unlink(missing_ok=True)
        for name in (*networks, renders.name):
            # A folder that exists counts as complete, so it loses its name first.
            removed = out / f"{name}.part"
            shutil.rmtree(removed, ignore_errors=True)
            if (out / name).exists():
                (out / name).rename(removed)
            shutil.rmtree(removed, ignore_errors=True)
    elif (out / CONFIG).exists():
        require_same(out, settings, "out=", _may_change)
    write_config(out, settings, command=command_line("audit"))


def _may_change(key: str, old: Any, new: Any) -> bool:
    """Return whether a stopped audit may continue with a change of a setting: only from None."""
    return old is None and key in SETTABLE_LATER


def laboratory_settings(settings: AuditSettings, out: Path, size: int) -> LabSettings:
    """Choose the settings of the path-traced renders on which an audit scores networks.

    They show the meshes and the hard negatives under each pattern of PATTERNS,
    and in each environment map of the audit.
    """
    meshes, hard_negatives = read_meshes(settings)
    lighting_count = len(PATTERNS) + len(settings.environments)
    return LabSettings(
        out=str(out),
        label=settings.label,
        meshes=[asdict(item) for item in (*meshes, *hard_negatives)],
        setups=settings.scale(SETUPS) * lighting_count,
        patterns=[*PATTERNS],
        environments=settings.environments,
        size=size,
        spp=SPP,
        seed=settings.seed,
    )


def read_meshes(settings: AuditSettings) -> tuple[list[ObjectSettings], list[ObjectSettings]]:
    """Read the settings of the meshes and of the hard negatives, with their labels.

    A hard negative without a label gets a label that starts with "other_", which need not be a
    class of the networks. The first list has the meshes of the class, the second the hard
    negatives.
    """
    meshes = [*read_objects(settings.meshes, settings.label, "meshes").values()]
    hard_negatives = [*read_objects(settings.hard_negatives, "", "hard_negatives").values()]
    for item in hard_negatives:
        item.label = item.label or OTHER_PREFIX + (solid_name(item.mesh) or Path(item.mesh).stem)
    for item in meshes:
        if item.label != settings.label:
            raise InputError(
                f"meshes has {item.mesh} of the class {item.label}, but label={settings.label}: "
                "give only meshes of this class, and others as hard_negatives",
                "meshes",
            )
    return meshes, hard_negatives


def _require_continuable(out: Path, overwrite: bool, is_named: bool) -> None:
    """Check that an audit may write to a folder, because it is new or can be continued.

    An audit of networks that the caller passes as objects is never continued. config.yaml does not
    have their names, so the results may be about other networks.
    """
    # Files with these names are results of this audit, which continues with them.
    own_results: Collection[str] = ()
    # A folder without config.yaml raises an InputError.
    with suppress(InputError):
        is_audit = "hard_negatives" in read_config(out / CONFIG)
        if is_named and is_audit:
            own_results = RESULTS
    require_replaceable(out, "out", overwrite, own=own_results)


def _write_json(path: Path, measure: Callable[..., Mapping[str, Any]], *arguments: Any) -> None:
    """Write the return value of a function to a JSON file, unless the file exists."""
    if not path.exists():
        atomic_write(path, json.dumps(measure(*arguments)) + "\n", durable=True)


def _search(classifier: Classifier, views: Views) -> dict[str, Any]:
    """Find views in ordinary light, and return the attributes of `PlainViews` as a dictionary."""
    return asdict(find_plain_views(classifier, views))


def _evaluate(predictor: Predictor, folder: Path, label: str, out: Path) -> None:
    """Score a network on a folder of photographs. Unreadable photographs are left out."""
    evaluate_photographs(predictor, folder, label, out, skip_unreadable=True)


def _write_folder(folder: Path, write: Callable[[Path], object]) -> None:
    """Write a result of the audit to a folder, unless the folder exists.

    The result is written to FOLDER.part, which is renamed when it is complete.
    """
    if not folder.exists():
        unfinished = folder.with_name(f"{folder.name}.part")
        shutil.rmtree(unfinished, ignore_errors=True)
        write(unfinished)
        unfinished.rename(folder)
