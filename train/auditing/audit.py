"""Run the audit of pnb-audit.

An audit has many parts, such as the attacks on one network with one kind of
lighting. Each part is measured once, and its file is written completely or not
at all. An audit that was stopped therefore continues with the first missing
part. `train.auditing.audit_page` reads the files and writes the report.
"""

import json
import shutil
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import nullcontext, suppress
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

from augment.classifiers import Classifier
from augment.scene.objects import load_object
from augment.settings import ObjectSettings
from renderer.errors import InputError
from renderer.io.files import atomic_write
from renderer.light.presets import UNIFORM, load_light
from renderer.mitsuba_scene import mitsuba
from train import console
from train.auditing import audit_page as page
from train.auditing.lights import (
    KINDS,
    QUERIES,
    Views,
    recognized,
    success_by_light,
    transfer_success,
)
from train.auditing.plain_light import PlainViews, find_plain_views
from train.auditing.relit_audit import (
    RELIT_PART,
    measure_photographs,
    photographs_screen,
    write_photographs_page,
)
from train.auditing.remedies import CLASSIFIER, HARDENED, NORMALIZED, name_remedies, normalizing
from train.class_names import class_name, class_of_meshes, require_others, with_class_name
from train.command import command_line
from train.command_settings import AuditSettings, LabSettings
from train.data.photographs import OTHER_PREFIX, find_photographs, find_unlabeled
from train.evaluation.laboratory.laboratory import write_laboratory
from train.evaluation.scores.predictions import Predictor
from train.evaluation.scores.scoring import evaluate_photographs
from train.report.results import RESULTS, require_replaceable
from train.runs.run_config import CONFIG, read_config, read_json, require_same, write_config
from train.runs.run_lock import sole_writer
from train.runs.saved_networks import load_chosen, load_network
from train.settings import published, read_objects, simplified, solid_name
from train.system.device import choose_device
from train.system.user_errors import keyed, writable_folder

# Views that are rendered in environment lighting.
VIEWS = 24
# Random lights in addition to the environments.
LIGHTS = 8
# Views that are attacked with each kind of lighting.
ATTACKED = 12
# Number of draws of light, camera and pose in the laboratory, for each projected
# pattern and each environment.
SETUPS = 6
# Projected patterns that no training of this project uses.
PATTERNS = ("gradient", "rings", "window", "leaves", "text", "colors")
# Paths per pixel of the renders of the laboratory.
SPP = 48
# Generated things that stand for hard negatives which the user does not name.
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
# Settings of pnb-audit that name a folder of images to score. The keys are the
# names of these images on the page.
FOLDER_KEYS = {page.LABORATORY: "laboratory", page.PHOTOGRAPHS: "photos"}
# Keys of settings that may be set when a stopped audit continues.
ADDED = ("hardened", "photos", "photographs")


def run_audit(
    settings: AuditSettings,
    networks: Mapping[str, Classifier] | None = None,
) -> page.Audited:
    """Measure the parts that are missing in the folder `settings.out`, and write the report.

    Args:
        settings: Settings of the audit.
        networks: Networks by `CLASSIFIER` and `HARDENED` of the report. None to
            load those that the settings name.

    Returns:
        The report.

    Raises:
        InputError: If an input cannot be read, if a network lacks a class, or
            if the folder holds other results.
    """
    is_named = networks is None
    if networks is None:
        networks = load_networks(settings)
    if not settings.meshes:
        return _audit_photographs(settings, networks, is_named)
    # Sentences that the report shows at its beginning.
    caveats = _compare_sizes(networks.values())
    if not (settings.hard_negatives or settings.laboratory):
        caveats.append(NO_HARD_NEGATIVES)
    settings = complete(settings, networks[CLASSIFIER])
    plan = _Plan(settings, networks)
    out = writable_folder(settings.out, "out")
    # Networks that the caller passes have no names in config.yaml. It is unknown
    # whether the results in the folder are of the same networks, so an audit of
    # such networks does not continue.
    own = _own_results(out) if is_named else ()
    require_replaceable(out, "out", settings.overwrite, own=own)
    renders = out / "renders"
    has_renders = renders.exists() and not settings.overwrite
    if page.LABORATORY not in plan.folders:
        try:
            # New renders need Mitsuba.
            with nullcontext() if has_renders else mitsuba():
                plan.folders = {page.LABORATORY: renders} | plan.folders
        except InputError as error:
            caveats.append(f"The laboratory is left out, and hard_negatives with it ({error}).")
    caveats += _missing_gradients(networks.values())
    for sentence in caveats:
        console.warning(sentence)
    with sole_writer("out", out):
        _begin(settings, out, renders)
        plan.find_views(out / CLASSIFIER)
        if plan.folders.get(page.LABORATORY) == renders:
            size = max(network.size for network in plan.networks.values())
            laboratory = laboratory_settings(settings, renders, size)
            _write_folder(
                renders,
                lambda folder: write_laboratory(replace(laboratory, out=str(folder))),
            )
        for key, network in plan.networks.items():
            plan.measure(key, out / key)
            if settings.photographs:
                _measure_photographs(network, settings, out / key)
        plan.score_in_normalized_light(out)
        remedies = name_remedies(plan.networks)
        names = _names(plan.networks)
        return page.write_audit_page(settings.label, names, remedies, plan.folders, out, caveats)


def _audit_photographs(
    settings: AuditSettings, networks: Mapping[str, Classifier], is_named: bool
) -> page.Audited:
    """Audit networks on relit photographs alone, and write the report.

    Args:
        settings: Settings of an audit without meshes.
        networks: Networks by the name of the folder of their parts.
        is_named: Whether the settings name the networks. Only then may an audit
            that was stopped continue.
    """
    device = choose_device(settings.device)
    find_unlabeled(published(Path(str(settings.photographs))))
    out = writable_folder(settings.out, "out")
    own = _own_results(out) if is_named else ()
    require_replaceable(out, "out", settings.overwrite, own=own)
    caveats = _compare_sizes(networks.values())
    for network in networks.values():
        if not network.has_gradients:
            caveats.append(f"{network.name} has no gradients: only random search attacks it.")
    for sentence in caveats:
        console.warning(sentence)
    with sole_writer("out", out):
        _begin(settings, out, out / "renders")
        for key, network in networks.items():
            (out / key).mkdir(exist_ok=True)
            _measure_photographs(network.to(device), settings, out / key)
        names = _names(networks)
        paths = {name: out / key for key, name in names.items()}
        screen = photographs_screen(paths)
        path = write_photographs_page(screen, paths, out, caveats)
        return page.Audited(path, screen, "", names, None)


def _measure_photographs(network: Classifier, settings: AuditSettings, own: Path) -> None:
    """Measure a network on relit photographs, unless this part exists in its folder."""
    _write_folder(own / RELIT_PART, partial(measure_photographs, network, settings))


def _names(networks: Mapping[str, Classifier]) -> dict[str, str]:
    """Return a name of each network, by the key of the network.

    If both networks have the same name, " (hardened)" follows the second one.
    """
    names = {key: network.name for key, network in networks.items()}
    if len(set(names.values())) < len(names):
        names[HARDENED] += " (hardened)"
    return names


class _Plan:
    """Networks and images of an audit, which are checked before anything is written.

    Attributes:
        label: Class whose objects are tested.
        device: Device of the networks and the renders.
        networks: Networks by the name of the folder of their parts.
        folders: Folders of labeled images by the name of the part.
        environments: Names or files of environments.
        random_light_count: Number of random lights.
        views: Views that are rendered in environment lighting.
        attacked_views: Views that are attacked.
    """

    def __init__(self, settings: AuditSettings, networks: Mapping[str, Classifier]):
        self.label = settings.label
        self.device = choose_device(settings.device)
        self.networks = {key: network.to(self.device) for key, network in networks.items()}
        meshes, hard_negatives = read_meshes(settings)
        folders = {page.LABORATORY: settings.laboratory, page.PHOTOGRAPHS: settings.photos}
        self.folders = {part: published(Path(folder)) for part, folder in folders.items() if folder}
        items = [*meshes, *hard_negatives]
        _require_classes(self.networks.values(), items, self.folders, self.label)
        # The hard negatives are loaded, too, so that an unreadable file is
        # reported at once.
        objects = [load_object(item) for item in items]
        for name in settings.environments:
            load_light(name)
        self.environments = [UNIFORM, *settings.environments]
        self.random_light_count = settings.scale(LIGHTS)
        seed = settings.seed
        subjects = objects[: len(meshes)]
        self.views = Views(subjects, settings.scale(VIEWS), seed, self.device)
        self.attacked_views = Views(subjects, settings.scale(ATTACKED), seed, self.device)

    def find_views(self, own: Path) -> None:
        """Search views that the audited classifier recognizes in plain light, for all networks.

        Args:
            own: Folder that the result for the audited classifier is written to.
        """
        own.mkdir(exist_ok=True)
        path = own / page.PLAIN
        _write_part(path, _search, self.networks[CLASSIFIER], self.attacked_views)
        plain = PlainViews(**read_json(path))
        self.views = plain.apply_to(self.views)
        self.attacked_views = plain.apply_to(self.attacked_views)

    def measure(self, key: str, own: Path) -> None:
        """Measure the missing parts of one network.

        Args:
            key: Key of the network in `networks`.
            own: Folder of its parts.
        """
        network = self.networks[key]
        own.mkdir(exist_ok=True)
        lights = (self.environments, self.random_light_count)
        _write_part(own / page.RECOGNIZED, recognized, network, self.views, *lights)
        for kind in KINDS:
            path = own / f"{kind}.json"
            _write_part(path, success_by_light, network, self.attacked_views, kind, own)
        self._score(network, own)
        others = [other for other in self.networks.values() if other is not network]
        if others:
            path = own / page.TRANSFER
            _write_part(path, transfer_success, network, *others, self.attacked_views, own)

    def score_in_normalized_light(self, out: Path) -> None:
        """Score the networks with normalized light in front on the folders of images.

        Args:
            out: Folder of the audit.
        """
        for key, network in normalizing(self.networks).items():
            self._score(network, out / key)

    def _score(self, network: Classifier, own: Path) -> None:
        """Score a network on each folder of images.

        Args:
            network: Network with or without normalized light.
            own: Folder of the parts of this network. The scores on each folder
                of images go to a sub-folder.
        """
        for name, folder in self.folders.items():
            own.mkdir(exist_ok=True)
            predictor = Predictor(network, network.classes, network.size, self.device)
            _write_folder(own / name, partial(_evaluate, predictor, folder, self.label))


def complete(settings: AuditSettings, classifier: Classifier) -> AuditSettings:
    """Fill in the class and the hard negatives that the settings leave out.

    Args:
        settings: Settings of the audit.
        classifier: The audited classifier, which has the classes.

    Returns:
        Settings with the class by its name, and with hard negatives if they
        are needed.

    Raises:
        InputError: If the classifier lacks a class, if neither `label` nor
            the names of the meshes tell the class, or if a hard negative is of
            this class.
    """
    if settings.label is None:
        label = class_of_meshes(settings.meshes, classifier.classes, "meshes")
    else:
        label = class_name(classifier.classes, settings.label, "label")
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
    """Load the classifier and, if there is one, the hardened network.

    Args:
        settings: Settings of the audit.

    Returns:
        The networks by the name of the folder of their parts.

    Raises:
        InputError: If there is no such network.
    """
    with keyed(name="classifier"):
        classifier = load_chosen(settings)
    networks = {CLASSIFIER: classifier}
    if settings.hardened:
        with keyed(name="hardened"):
            networks[HARDENED] = load_network(settings.hardened)
    return networks


def _require_classes(
    networks: Collection[Classifier],
    items: Sequence[ObjectSettings],
    folders: Mapping[str, Path],
    label: str,
) -> None:
    """Raise InputError if a network lacks the class of a mesh or of a photograph.

    Args:
        networks: Networks of the audit.
        items: Meshes and hard negatives. Classes that start with OTHER_PREFIX
            need not be classes of a network.
        folders: Folder of labeled images by part.
        label: Class whose objects are tested.
    """
    labels = {item.label for item in items if not item.label.startswith(OTHER_PREFIX)}
    for network in networks:
        for name in labels:
            network.label(name)
        for part, folder in folders.items():
            with keyed(FOLDER_KEYS[part]):
                find_photographs(folder, network.classes, label)


def _compare_sizes(networks: Collection[Classifier]) -> list[str]:
    """Return a caveat if the networks take images of different sizes, and otherwise nothing."""
    sizes = [str(network.size) for network in networks]
    if len(set(sizes)) == 1:
        return []
    listed = " and ".join(sizes)
    return [f"The networks take images of {listed} pixels, and differ by that, too."]


def _missing_gradients(networks: Collection[Classifier]) -> list[str]:
    """Return a caveat for each network that has no gradients."""
    return [
        f"{network.name} has no gradients: random search attacks each view with {QUERIES} queries "
        "for each radius."
        for network in networks
        if not network.has_gradients
    ]


def _begin(settings: AuditSettings, out: Path, renders: Path) -> None:
    """Prepare the folder of an audit, and write config.yaml.

    With `overwrite`, the parts of an earlier audit are removed. Otherwise the
    folder must have the same settings as this audit.

    Args:
        settings: Settings of the audit.
        out: Folder of the audit.
        renders: Folder of the renders of the laboratory in `out`.

    Raises:
        InputError: If the folder has other settings.
    """
    if settings.overwrite:
        networks = (CLASSIFIER, HARDENED, CLASSIFIER + NORMALIZED, HARDENED + NORMALIZED)
        for name in (*networks, renders.name):
            shutil.rmtree(out / name, ignore_errors=True)
    elif (out / CONFIG).exists():
        require_same(out, settings, "out=", _may_be_added)
    write_config(out, settings, command=command_line("audit"))


def _may_be_added(key: str, old: Any, new: Any) -> bool:
    """Return whether a setting may change when an audit continues.

    Args:
        key: Key of the setting.
        old: Value in config.yaml. Only None may change.
        new: Value of this command.
    """
    return old is None and key in ADDED


def laboratory_settings(settings: AuditSettings, out: Path, size: int) -> LabSettings:
    """Choose the settings of the renders: setups of all patterns and all environments.

    Args:
        settings: Settings of the audit.
        out: Folder of the renders.
        size: Pixels per side of the renders.

    Returns:
        Settings of pnb-lab.
    """
    meshes, hard_negatives = read_meshes(settings)
    kind_count = len(PATTERNS) + len(settings.environments)
    return LabSettings(
        out=str(out),
        label=settings.label,
        meshes=[asdict(item) for item in (*meshes, *hard_negatives)],
        setups=settings.scale(SETUPS) * kind_count,
        patterns=[*PATTERNS],
        environments=settings.environments,
        size=size,
        spp=SPP,
        seed=settings.seed,
    )


def read_meshes(settings: AuditSettings) -> tuple[list[ObjectSettings], list[ObjectSettings]]:
    """Read the settings of the meshes and of the hard negatives.

    A hard negative without a label gets a label that starts with OTHER_PREFIX. The
    networks need not have a class for this label.

    Args:
        settings: Settings of the audit.

    Returns:
        Settings of the meshes of the label, and of the hard negatives.

    Raises:
        InputError: If a mesh has another label than `settings.label`.
    """
    meshes = [*read_objects(settings.meshes, settings.label, "meshes").values()]
    hard_negatives = [*read_objects(settings.hard_negatives, "", "hard_negatives").values()]
    for item in hard_negatives:
        item.label = item.label or OTHER_PREFIX + (solid_name(item.mesh) or Path(item.mesh).stem)
    for item in meshes:
        if item.label != settings.label:
            raise InputError(
                f"meshes: {item.mesh} is of the class {item.label}, and label={settings.label}",
                "meshes",
            )
    return meshes, hard_negatives


def _own_results(out: Path) -> Collection[str]:
    """Return the patterns of the results with which an audit in a folder continues.

    Returns:
        RESULTS if the folder is the folder of an audit. Otherwise nothing.
    """
    with suppress(InputError):
        if "hard_negatives" in read_config(out / CONFIG):
            return RESULTS
    return ()


def _write_part(path: Path, measure: Callable[..., Mapping[str, Any]], *arguments: Any) -> None:
    """Measure a part of an audit, and write it as JSON, unless its file exists.

    Args:
        path: File of the part.
        measure: Function that returns the content of the file.
        *arguments: Arguments of this function.
    """
    if not path.exists():
        atomic_write(path, json.dumps(measure(*arguments)) + "\n", durable=True)


def _search(classifier: Classifier, views: Views) -> dict[str, Any]:
    """Search views in plain light, and return the fields of `PlainViews` by name."""
    return asdict(find_plain_views(classifier, views))


def _evaluate(predictor: Predictor, folder: Path, label: str, out: Path) -> None:
    """Score a network on the photographs of `folder`, and write the scores to `out`.

    Photographs that cannot be read are left out.
    """
    evaluate_photographs(predictor, folder, label, out, skip_unreadable=True)


def _write_folder(folder: Path, write: Callable[[Path], object]) -> None:
    """Write a part of an audit that is a folder, unless the folder exists.

    The folder gets its name when it is complete. Until then, ".part" follows
    the name.

    Args:
        folder: Folder of the part.
        write: Function that writes the part to the folder that it is given.
    """
    if not folder.exists():
        unfinished = folder.with_name(f"{folder.name}.part")
        shutil.rmtree(unfinished, ignore_errors=True)
        write(unfinished)
        unfinished.rename(folder)
