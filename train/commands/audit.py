"""pnb-audit and nb.audit: how safe a network is in unusual lighting.

An audit consists of many measurements, such as the attacks on one network with
one kind of lighting. Each result is written to its own file or folder, completely
or not at all. An audit that was stopped therefore continues with the first
missing result. `train.auditing.page` then reads all results and writes the
report.

The folder of the audit has a subfolder of results for each network. The names of
the subfolders are CLASSIFIER and HARDENED.
"""

import math
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext, suppress
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from augment.attack_settings import RelightingSettings
from augment.classifier import UNIT_RANGE, Classifier, Normalization, TaskNetwork, as_network
from augment.network import device_of, gradient_flags_kept
from augment.scene.objects import load_object
from augment.settings import NormalizeLight
from augment.tasks.detection import Detection
from augment.tasks.task import Task
from renderer.errors import InputError, as_list, keyed
from renderer.light.files import UNIFORM, load_light
from renderer.mitsuba_scene import mitsuba
from renderer.settings import Size, height_and_width
from train import class_names, console, run_folder
from train.auditing import lights, page, relit
from train.auditing import network as audited
from train.auditing.network import CLASSIFIER, HARDENED, IN_WORDS, AuditReport
from train.checkpoints import hash_weights, load_chosen, load_network, with_task
from train.command_settings import ENVIRONMENTS, AuditSettings, LabSettings
from train.data.annotations import read_annotations
from train.data.photo import DESCRIPTION
from train.data.photographs import find_photographs, find_unlabeled
from train.device import choose_device
from train.laboratory.laboratory import write_laboratory
from train.results.overwrite import output_folder
from train.results.page import PAGE
from train.results.scoring import Predictor, evaluate_photographs
from train.run_config import CONFIG, read_config, require_same, require_same_weights, write_config
from train.run_folder import read_json, sole_writer
from train.settings import LABORATORY, OTHER_PREFIX, PHOTOGRAPHS, published_folder, read_objects
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
# Number of light paths per pixel of the path-traced renders. The noise is 1.3 of 255 on average.
SPP = 16
# Generated solids that serve as hard negatives if the user names none.
NEGATIVE_SOLIDS = ("lemon", "apple", "peach", "pear", "sweet_pepper", "ball")
NO_HARD_NEGATIVES = (
    "hard_negatives is empty, so false positives are measured on generated fruit and balls; "
    "name meshes of what the classifier may confuse with the class."
)
NO_PHOTOGRAPHS = (
    "photos shows no objects of other classes, and a hardened network may take similar objects on "
    "real photographs for the class, which renders do not show: give photographs of such objects."
)
# When a stopped audit continues, these settings may be set if they were not set before.
SETTABLE_LATER = ("hardened", "photos", "unlabeled")
# The networks of an audit, by their keys CLASSIFIER and HARDENED.
Networks = Mapping[str, Classifier]


def run(settings: AuditSettings) -> None:
    """Test a network in unusual lighting, and print the main numbers and the path of the report."""
    result = run_audit(settings)
    print(f"{result.screen}\nreport: {result.path}")


@torch.inference_mode(False)  # Attacks need autograd.
def audit(
    network: TaskNetwork | Callable[[Tensor], Any],
    meshes: Sequence[class_names.MeshItem],
    label: str | int | None = None,
    *,
    hard_negatives: Sequence[class_names.MeshItem] = (),
    hardened: TaskNetwork | Callable[[Tensor], Any] | None = None,
    classes: Sequence[str] | None = None,
    size: Size | None = None,
    normalization: Normalization = None,
    value_range: tuple[float, float] = UNIT_RANGE,
    normalize_light: NormalizeLight = None,
    photos: str | Path | None = None,
    laboratory: str | Path | None = None,
    environments: Sequence[str] = ENVIRONMENTS,
    budget: float = 1.0,
    task: Task | None = None,
    seed: int = 0,
    device: torch.device | str | None = None,
    out: str | Path | None = None,
    overwrite: bool = False,
) -> AuditReport:
    """Measure how safe a network is in unusual lighting.

    Nothing is written unless `out` is given.

    Args:
        network: A classifier, a detector or a segmenter, or a plain network from
            images to their outputs, such as a `torch.nn.Module`.
        meshes: Meshes of one class: files, solids such as "solid:orange",
            `nb.Mesh`, or pairs of these and the class.
        label: Class of all meshes, by name or index. None if each mesh is given
            in a pair with its class, or if its name is the class, as in
            "orange.glb".
        hard_negatives: Meshes of other classes, rendered in the same lighting,
            with or without a class. Empty for generated fruit and balls.
        hardened: Hardened network, which is audited in the same way and shown
            beside `network`. None to audit one network.
        classes: Names of the classes of plain networks, in the order of their
            outputs. None for "0", "1" and so on.
        size: Pixels per side of the images of plain networks, or (height, width). None
            for its own, or 224.
        normalization: "imagenet", or mean and standard deviation, as `attack`
            takes it.
        value_range: Values of black and white that plain networks take before
            normalization.
        normalize_light: Normalization of the light of each image before it
            enters `network`, and `hardened` if that is a plain network. Values
            are as for `load_classifier`. Attacks take it into account.
        photos: Folder of photographs with a sub-folder for each class or, for a
            detector, photographs with boxes, as for `evaluate`. None to use no
            photographs.
        laboratory: Folder of renders with a sub-folder for each class, such as
            "pretrained/laboratory". None to render them from the meshes, for
            which Mitsuba is needed.
        environments: Names of environment lightings, or files of maps.
        budget: Factor of the number of views, lightings and renders. With 1, a
            network of 224 pixels takes about 7 minutes on one core.
        task: Task of the networks, such as `nb.Detection(threshold=0.3)`. None if
            the outputs tell.
        seed: Seed of all random draws.
        device: Device that computes. None for the device of the network.
        out: Folder for the files of the audit. None to write no files.
        overwrite: Whether to replace results in `out`.

    Returns:
        Report with all numbers. `save("audit.html")` writes it as a page.

    Raises:
        InputError: If an input cannot be read, or if a network lacks a class.

    Example:
        >>> import norm_balls as nb
        >>> report = nb.audit(
        ...     network,
        ...     ["solid:orange"],
        ...     classes=["orange", "apple"],
        ...     size=32,
        ...     laboratory="pretrained/laboratory",
        ... )  # doctest: +SKIP
        >>> report.network.attacks["lamps"].adversarial  # doctest: +SKIP
        (0, 1, 5, 12)
    """
    device = device_of(network) if device is None else device
    options = (size, classes, normalization, value_range, device)
    with gradient_flags_kept(network), gradient_flags_kept(hardened):
        named: dict[str, Any] = {"normalize_light": normalize_light, "task": task}
        networks: dict[str, Any] = {CLASSIFIER: as_network(network, *options, **named)}
        if hardened is not None:
            if isinstance(hardened, TaskNetwork):
                # A `TaskNetwork` knows itself whether it normalizes light.
                named["normalize_light"] = None
            networks[HARDENED] = as_network(hardened, *options, argument="hardened", **named)
        with run_folder.folder_or_temporary(out) as folder:
            # `run_audit` takes settings, as the command does, so the arguments become settings.
            items = class_names.as_mappings("meshes", meshes)
            negatives = class_names.as_mappings("hard_negatives", hard_negatives)
            folders = {"photos": photos, "laboratory": laboratory, "out": folder}
            given: dict[str, Any] = {key: path and str(path) for key, path in folders.items()}
            given |= {"label": label, "meshes": items, "hard_negatives": negatives, "seed": seed}
            given |= {"budget": budget, "device": str(device), "overwrite": overwrite}
            maps = as_list("environments", environments, str, "a list of names")
            settings = AuditSettings(network=networks[CLASSIFIER].name, environments=maps, **given)
            return run_audit(settings, networks).report()


def run_audit(settings: AuditSettings, networks: Networks | None = None) -> page.Audited:
    """Test networks in unusual lighting, and write a report to the folder `settings.out`.

    Results that an earlier, stopped audit wrote to this folder are not measured again. The keys
    of `networks` are CLASSIFIER and HARDENED. None loads those that the settings name.
    """
    is_named = networks is None
    device = choose_device(settings.device)
    loaded: dict[str, Any] = {**networks} if networks else {CLASSIFIER: load_chosen(settings)}
    if is_named and settings.hardened:
        with keyed(name="hardened"):
            other = load_network(settings.hardened, trust_code=settings.trust)
            loaded[HARDENED] = with_task(other, settings)
    networks = {key: network.to(device) for key, network in loaded.items()}
    # Without meshes, only photographs are attacked, and there is no plan.
    plan, given = None, settings
    if settings.meshes:
        settings = complete(settings, networks[CLASSIFIER].classes)
        plan = _Plan(settings, networks, device)
    if settings.unlabeled:
        find_unlabeled(published_folder(Path(settings.unlabeled)))
    caveats = _caveats(given, networks, plan)
    # config.yaml does not name networks that the caller passes as objects, so the results there may
    # be about others. A folder without config.yaml raises an InputError.
    is_continued = False
    with suppress(InputError):
        is_continued = is_named and "hard_negatives" in read_config(Path(settings.out) / CONFIG)
    out = output_folder(settings.out, settings.overwrite or is_continued)
    renders = out / "renders"
    # Renders of an earlier, stopped audit are used again, and need no Mitsuba.
    has_renders = renders.exists() and not settings.overwrite
    if plan is not None and plan.has_classes and LABORATORY not in plan.image_folders:
        if has_renders:
            rendered, size = read_json(renders / DESCRIPTION)["size"], largest_size(networks)
            if height_and_width(rendered) != height_and_width(size):
                fault = f"hardened needs test images of {size} pixels, but {renders} has {rendered}"
                raise InputError(f"{fault}: choose another out, or set overwrite=true", "hardened")
        try:
            # `mitsuba` raises an InputError if Mitsuba, which renders, is not installed.
            with nullcontext() if has_renders else mitsuba():
                plan.image_folders = {LABORATORY: renders} | plan.image_folders
        except InputError as error:
            caveats.append(f"The laboratory is left out, and hard_negatives with it ({error}).")
    for sentence in caveats:
        console.warning(sentence)
    described = [f"Images of {one.name}: {one.describe_inputs()}." for one in networks.values()]
    caveats = [*described, *caveats]
    with sole_writer(out):
        _prepare_folder(settings, out, renders, networks)
        for key in networks:
            (out / key).mkdir(exist_ok=True)
        names = {key: network.name for key, network in networks.items()}
        # Both networks can have the same name.
        if len({*names.values()}) < len(names):
            names[HARDENED] += " (hardened)"
        # Without meshes, the page is about photographs, and has no label.
        label = settings.label if plan else ""
        write_page = partial(page.write_audit_page, label, names, audited.name_remedies(networks))
        for missing, folders in plan.measure(networks, out) if plan else ():
            path = write_page(folders, out, caveats, missing).path
            # A caller from Python gets the complete page.
            if is_named:
                console.warning(f"first results: {path}")
        if settings.unlabeled:
            try:
                _attack_photographs(settings, networks, out)
            except InputError as error:
                # The results of the meshes are shown.
                if plan is None:
                    raise
                caveats.append(f"The light of the photographs was not attacked: {error}.")
                console.warning(caveats[-1])
        return write_page(plan.image_folders if plan else {}, out, caveats)


def _attack_photographs(settings: AuditSettings, networks: Networks, out: Path) -> None:
    """Attack the light of photographs without labels, and write the results for each network."""
    # A path below pretrained/ is found from any working folder.
    photographs = published_folder(Path(str(settings.unlabeled)))
    attack = RelightingSettings(passes=relit.PASSES)
    count = settings.scale(relit.PHOTOGRAPH_COUNT)
    options: dict[str, Any] = {"seed": settings.seed, "limit": count}
    for key, network in networks.items():
        # The folder is written in one step, so a folder that exists is complete.
        write = partial(relit.attack_folder, network, photographs, attack, **options)
        _write_folder(out / key / relit.RELIT_FOLDER, write)


def _caveats(settings: AuditSettings, networks: Networks, plan: "_Plan | None") -> list[str]:
    """Write sentences for the beginning of the report."""
    caveats = []
    sizes = [str(network.size) for network in networks.values()]
    if len({*sizes}) > 1:
        listed = " and ".join(sizes)
        caveats.append(f"The networks take images of {listed} pixels, and differ by that, too.")
    if settings.meshes and not (settings.hard_negatives or settings.laboratory):
        caveats.append(NO_HARD_NEGATIVES)
    if plan is not None and HARDENED in networks and not plan.has_other_photographs:
        caveats.append(NO_PHOTOGRAPHS)
    for network in networks.values():
        if plan is None and not isinstance(network, Classifier):
            continue
        # `render` makes images by which the network is tried. A classifier needs none.
        render: Callable[[], Tensor] = partial(torch.empty, 0, device=device_of(network))
        if plan is not None:
            # Only an image with an object tells whether a detector has gradients.
            render = partial(lights.plain_images, plan.attacked_views, network.size)
        if not network.is_differentiable(render):
            caveats.append(f"{network.name} has no gradients: only random search attacks it.")
    return caveats


class _Plan:
    """Images and lighting of an audit, checked before anything is written.

    Attributes:
        settings: Settings of the audit, whose label is the class whose objects are tested.
        items: Meshes and hard negatives, which need not be of a class of the networks.
        image_folders: Folders of labeled test images: "laboratory" for
            path-traced renders, and "photographs". Each may be missing.
        environments: Names or files of environment lights.
        random_light_count: Number of random environment lights.
        views: Views that are rendered in environment lighting.
        attacked_views: Views whose lighting is attacked.
    """

    def __init__(self, settings: AuditSettings, networks: Networks, device: torch.device):
        self.settings = settings
        meshes = [*read_objects(settings.meshes, settings.label, "meshes").values()]
        hard_negatives = [*read_objects(settings.hard_negatives, "", "hard_negatives").values()]
        for item in hard_negatives:
            # Such a label is of no class of the network, and names a folder of test images.
            if item.label == "":
                item.label = OTHER_PREFIX + class_names.name_of_mesh(item.mesh)
        for item in meshes:
            if item.label != settings.label:
                fault = f"meshes has {item.mesh} of the class {item.label}, not {settings.label}"
                raise InputError(f"{fault}: give others as hard_negatives", "meshes")
        self.items = [*meshes, *hard_negatives]
        folders = {LABORATORY: settings.laboratory, PHOTOGRAPHS: settings.photos}
        self.has_classes = all(isinstance(network, Classifier) for network in networks.values())
        # Boxes of objects in photographs, which only a detector needs.
        self.annotations = None
        if not self.has_classes:
            tasks = {network.task.name for network in networks.values()}
            if len(tasks) > 1:
                raise InputError(f"hardened is of another task: {' and '.join(sorted(tasks))}")
            if settings.laboratory or (settings.photos and tasks != {Detection.name}):
                reason = f"laboratory and photos are no images for {tasks.pop()}"
                raise InputError(f"{reason}: a detector takes photos with boxes")
            if settings.photos:
                with keyed("photos"):
                    self.annotations = read_annotations(published_folder(Path(settings.photos)))
            folders = {}
        self.image_folders = {
            name: published_folder(Path(folder)) for name, folder in folders.items() if folder
        }
        # A detector scores photographs without boxes of the label, too.
        self.has_other_photographs = self.annotations is not None
        # A network that lacks a class raises an InputError.
        labels = {of.label for of in self.items if not str(of.label).startswith(OTHER_PREFIX)}
        for network in networks.values():
            for name in labels:
                network.label(name)
            for name, folder in self.image_folders.items():
                with keyed("photos" if name == PHOTOGRAPHS else "laboratory"):
                    found = find_photographs(folder, network.classes, settings.label)
                if name == PHOTOGRAPHS:
                    self.has_other_photographs = any(item.label != settings.label for item in found)
        # Hard negatives and lights are loaded only to report a file that cannot be read
        # before the audit begins.
        positives = [load_object(item) for item in meshes]
        self.negatives = [load_object(item) for item in hard_negatives]
        for name in settings.environments:
            load_light(name)
        self.environments = [UNIFORM, *settings.environments]
        # Results are kept by the name of their light. Patterns are lights of rendered test images.
        patterns = PATTERNS if self.has_classes and not settings.laboratory else ()
        names = [Path(name).stem for name in (*patterns, *settings.environments)]
        names += [UNIFORM] * (UNIFORM not in settings.environments)
        if len({*names}) < len(names) or any(name.startswith(lights.RANDOM) for name in names):
            others = f"{', '.join([*patterns, UNIFORM])} or {lights.RANDOM}1"
            fault = f"environments={settings.environments} must have different names"
            raise InputError(f"{fault}, and none of {others}: rename a file", "environments")
        self.random_light_count = settings.scale(RANDOM_LIGHT_COUNT)
        # Most views are only shown in other light, and few are attacked, since this takes longer.
        self.views = lights.Views(positives, settings.scale(VIEW_COUNT), settings.seed, device)
        self.attacked_views = replace(self.views, count=settings.scale(ATTACKED_COUNT))

    def measured_folders(self) -> dict[str, Path]:
        """Return the folders of test images on which `measure` has scored the networks by now."""
        return {name: folder for name, folder in self.image_folders.items() if folder.exists()}

    def measure(self, networks: Networks, out: Path) -> Iterator[tuple[str, dict[str, Path]]]:
        """Test and attack the networks, except for results that exist already.

        What takes long comes last. Before it, yield what is still to come, in words, and the
        folders of test images that are scored. The views of all networks have the ordinary light
        and the size at which the audited network recognizes most views.
        """
        path = out / CLASSIFIER / lights.PLAIN
        _write_json(path, lights.find_plain_views, networks[CLASSIFIER], self.attacked_views)
        plain = lights.PlainViews(**read_json(path))
        views = replace(self.views, light=plain.light, exposure=plain.exposure, size=plain.size)
        attacked_views = replace(views, count=self.attacked_views.count)
        unusual = lights.environment_lights(views, self.environments, self.random_light_count)
        # Attacks within the largest radius, which go on with smaller radii, by the path of both.
        attacks: dict[Path, Iterator[dict[str, Any]]] = {}
        for key, network in networks.items():
            results = out / key
            recognize = lights.recognize_in_environments
            _write_json(results / lights.RECOGNIZED, recognize, network, views, unusual)
            for kind in lights.KINDS:
                path = results / f"{kind}.json"
                if not path.exists():
                    attacks[path] = lights.success_by_light(network, attacked_views, kind, results)
                    _write_json(results / (kind + lights.FIRST), next, attacks[path])
        self._score(networks, out)
        to_render = self.image_folders.keys() - self.measured_folders().keys()
        later = [IN_WORDS[name] for name in to_render]
        if attacks:
            yield " and ".join(["attacks within smaller radii", *later]), self.measured_folders()
        for path, counts in attacks.items():
            _write_json(path, lambda counts=counts: [*counts][-1])
            path.with_name(path.stem + lights.FIRST).unlink()
        for key, network in networks.items():
            results = out / key
            # Light that fools one network is shown to the other network.
            for other in networks.values():
                if other is not network:
                    shown = (network, other, attacked_views)
                    _write_json(results / lights.TRANSFER, lights.transfer_success, *shown)
            if not self.has_classes:
                negatives = replace(views, objects=self.negatives)
                lit = (network, views, attacked_views, negatives, unusual, results)
                _write_json(results / lights.DETECTED, lights.find_in_lights, *lit)
        if later:
            yield later[0], self.measured_folders()
            renders = self.image_folders[LABORATORY]
            _write_folder(renders, partial(_write_renders, self, largest_size(networks)))
            self._score(networks, out)

    def _score(self, networks: Networks, out: Path) -> None:
        """Score the networks on test images, also with the remedy "normalized light"."""
        for key, network in {**networks, **audited.normalizing(networks)}.items():
            for name, images in self.measured_folders().items():
                predictor = Predictor(network, network.classes, network.size, self.views.device)
                # Unreadable photographs are left out.
                evaluate = partial(evaluate_photographs, predictor, images, self.settings.label)
                _write_folder(out / key / name, partial(evaluate, skip_unreadable=True))
            if self.annotations is not None:
                write_scores = partial(lights.score_photographs, network, self.annotations)
                _write_folder(out / key / lights.BOXED, write_scores)


def largest_size(networks: Networks) -> Size:
    """Return the size of the largest images of the networks, which the test images get."""
    sizes = [network.size for network in networks.values()]
    return max(sizes, key=lambda size: math.prod(height_and_width(size)))


def complete(settings: AuditSettings, classes: Sequence[str]) -> AuditSettings:
    """Name all classes, and fill in the class and the hard negatives if they are left out.

    The class is that of the meshes. Hard negatives are only filled in if test images must be
    rendered.
    """
    label = class_names.class_of_meshes(settings.meshes, classes, "meshes", settings.label)
    negatives = settings.hard_negatives
    if not (negatives or settings.laboratory):
        # Solids of the class itself are no negatives.
        names = [one for one in NEGATIVE_SOLIDS if class_names.class_of_name(one, [label]) is None]
        negatives = [f"solid:{name}" for name in names]
    meshes = class_names.with_class_name(settings.meshes, classes, "meshes")
    negatives = class_names.with_class_name(negatives, classes, "hard_negatives")
    class_names.require_others(read_objects(negatives, "", "hard_negatives"), [label], classes)
    return replace(settings, label=label, meshes=meshes, hard_negatives=negatives)


def _prepare_folder(settings: AuditSettings, out: Path, renders: Path, networks: Networks) -> None:
    """Prepare the folder of an audit, and write the settings to its file config.yaml.

    With `settings.overwrite`, the results of an earlier audit are removed.
    Otherwise an earlier audit in the folder must have the same settings and weights.
    """
    hashes = {key: hash_weights(network.state_dict()) for key, network in networks.items()}
    if settings.overwrite:
        folders = (key + end for key in (CLASSIFIER, HARDENED) for end in ("", lights.NORMALIZED))
        (out / PAGE).unlink(missing_ok=True)
        for name in (*folders, renders.name):
            # A folder that exists counts as complete, so it loses its name first.
            removed = out / f"{name}.part"
            shutil.rmtree(removed, ignore_errors=True)
            with suppress(FileNotFoundError):
                (out / name).rename(removed)
            shutil.rmtree(removed, ignore_errors=True)
    elif (out / CONFIG).exists():
        # A stopped audit may continue with a change of some settings, but only from None.
        recorded = require_same(
            out, settings, "out=", lambda key, old, _: old is None and key in SETTABLE_LATER
        )
        names = {key: network.name for key, network in networks.items()}
        require_same_weights(out, hashes, names, recorded)
    write_config(out, settings, command=command_line("audit"), hashes=hashes)


def _write_renders(plan: _Plan, size: Size, out: Path) -> None:
    """Render the path-traced test images on which an audit scores networks.

    They show the meshes and the hard negatives under each pattern of PATTERNS,
    and in each environment map of the audit.
    """
    settings = plan.settings
    lab_settings = LabSettings(
        out=str(out),
        label=settings.label,
        meshes=[asdict(item) for item in plan.items],
        # Each lighting gets the same number of setups.
        setups=settings.scale(SETUPS) * (len(PATTERNS) + len(settings.environments)),
        patterns=[*PATTERNS],
        environments=settings.environments,
        size=size,
        spp=SPP,
        seed=settings.seed,
    )
    write_laboratory(lab_settings)


def _write_json(path: Path, measure: Callable[..., Any], *arguments: Any) -> None:
    """Write the mapping or the dataclass of a function to a JSON file, unless the file exists."""
    if not path.exists():
        run_folder.write_json(path, measure(*arguments), durable=True)


def _write_folder(folder: Path, write: Callable[[Path], object]) -> None:
    """Write a result to FOLDER.part and rename it when complete, unless FOLDER exists."""
    if not folder.exists():
        unfinished = folder.with_name(f"{folder.name}.part")
        shutil.rmtree(unfinished, ignore_errors=True)
        write(unfinished)
        unfinished.rename(folder)
