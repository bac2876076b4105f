"""The settings of pnb-audit, and its parts: each is measured once, written whole, and read by the page."""

import json
import shlex
import shutil
import sys
from collections.abc import Callable, Collection
from contextlib import nullcontext, suppress
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from omegaconf import MISSING

from augment.classifiers import load_classifier
from augment.objects import ObjectSettings, load_object
from renderer.errors import InputError, require_range
from renderer.io.files import write_whole
from renderer.io.mitsuba import mitsuba
from renderer.light.presets import UNIFORM, load_light
from train import console
from train.audit import page
from train.audit.lights import KINDS, Views, recognized, success_by_light, transfers
from train.device import choose_device
from train.errors import writable_folder
from train.lab.laboratory import write_laboratory
from train.lab.shots import LabSettings
from train.networks import published
from train.photographs.folder import FOREIGN, find_photographs
from train.photographs.predictions import Predictor
from train.photographs.scoring import evaluate_photographs
from train.results import RESULTS, require_replaceable
from train.run_folder import CONFIG, read_config, require_same, sole_writer, write_config
from train.settings import LARGEST_SEED, program, read_object, solid_name

VIEWS, LIGHTS, ATTACKED, SETUPS = 24, 8, 12, 6  # views, random lights, attacked views, and setups of each pattern
PATTERNS = ("gradient", "rings", "window", "leaves", "text", "colors")  # that training does not throw
SPP = 48  # paths per pixel
ADDED = ("hardened", "photos")  # keys that an audit may be given when it goes on


@dataclass
class AuditSettings:
    """The settings of pnb-audit. A mesh is a file, `solid:NAME:SEED` or a mapping with the keys of ObjectSettings."""

    classifier: str = MISSING  # a name that conf/attack.yaml explains
    weights: str | None = None  # the classifier's local weights file, if it brings none
    hardened: str | None = None  # another classifier to show beside it, such as run:runs/harden
    label: str = "orange"  # the class of the meshes; each class has an audit of its own
    meshes: list[Any] = field(default_factory=list)  # of the class
    look_alikes: list[Any] = field(default_factory=list)  # of other things, under the same lights
    photos: str | None = None  # a folder of photographs, as pnb-evaluate takes it
    laboratory: str | None = None  # the same of renders; null: made of the meshes, if Mitsuba is installed
    environments: list[str] = field(default_factory=lambda: ["grace", "eucalyptus", "st_peters"])  # or maps (.hdr ...)
    budget: float = 1.0  # factor of views, lights and renders; 1 takes EfficientNet-Lite0 18 minutes of one core
    overwrite: bool = False  # begin anew in a folder that holds an audit or other results
    seed: int = 0
    device: str = "auto"  # auto | cpu | cuda | cuda:N
    out: str = "runs/audits/${now:%Y-%m-%d}/${now:%H-%M-%S-%f}"  # that of an audit that was stopped goes on

    def __post_init__(self) -> None:
        require_range("budget", self.budget, 0.01, 100)
        require_range("seed", self.seed, 0, LARGEST_SEED)
        for name in ("meshes",) if self.laboratory else ("meshes", "look_alikes"):
            if not getattr(self, name):
                raise InputError(f"{name} is empty: name one mesh or more, as in {name}=[solid:orange]")
        if self.laboratory and self.look_alikes:
            raise InputError(
                f"look_alikes are rendered in place of laboratory={self.laboratory}: leave one of them out"
            )

    def times(self, count: int) -> int:
        """A count under the budget, at least 1."""
        return max(1, round(count * self.budget))

    def renders(self, out: Path, size: int) -> LabSettings:
        """The laboratory of all patterns and environments, for renders of a size."""
        count = self.times(SETUPS) * (len(PATTERNS) + len(self.environments))
        meshes, patterns = [asdict(item) for items in self.read_objects() for item in items], [*PATTERNS]
        lights: dict[str, Any] = {"patterns": patterns, "environments": self.environments, "setups": count, "spp": SPP}
        return LabSettings(str(out), self.label, meshes, **lights, size=size, seed=self.seed)

    def read_objects(self) -> tuple[list[ObjectSettings], list[ObjectSettings]]:
        """Meshes and look-alikes; of a class that networks may lack, unless they name one. InputError: of the wrong
        class."""
        meshes = [read_object(item, self.label, index, "meshes") for index, item in enumerate(self.meshes)]
        others = [read_object(item, "", index, "look_alikes") for index, item in enumerate(self.look_alikes)]
        for item in others:
            item.label = item.label or FOREIGN + (solid_name(item.mesh) or Path(item.mesh).stem)
        for key, items, own in (("meshes", meshes, True), ("look_alikes", others, False)):
            if wrong := next((item for item in items if (item.label == self.label) != own), None):
                raise InputError(f"{key}: {wrong.mesh} is of the class {wrong.label}, and label={self.label}")
        return meshes, others


def run_audit(settings: AuditSettings) -> Path:
    """Measure what is not yet measured in the folder `settings.out`, and write the page; returns its path."""
    device = choose_device(settings.device)
    networks = {page.CLASSIFIER: load_classifier(settings.classifier, settings.weights).to(device)}
    if settings.hardened:
        networks[page.HARDENED] = load_classifier(settings.hardened).to(device)
    meshes, others = settings.read_objects()
    given = {page.LABORATORY: settings.laboratory, page.PHOTOGRAPHS: settings.photos}
    folders = {part: published(Path(folder)) for part, folder in given.items() if folder}
    for network in networks.values():
        for label in {item.label for item in (*meshes, *others) if not item.label.startswith(FOREIGN)}:
            network.label(label)  # or InputError that names the network
        for folder in folders.values():
            find_photographs(folder, network.classes, settings.label)
    objects = [load_object(item) for item in (*meshes, *others)][: len(meshes)]  # all can be read
    for name in settings.environments:
        load_light(name)  # or InputError
    lights = [UNIFORM, *settings.environments], settings.times(LIGHTS)
    views, attacked = (Views(objects, settings.times(n), settings.seed, device) for n in (VIEWS, ATTACKED))
    out = writable_folder(settings.out, "out")
    require_replaceable(out, "out", settings.overwrite, own=_own_results(out))
    caveats, renders = list[str](), out / "renders"  # an object of the label and another in every light
    sizes = [str(network.size) for network in networks.values()]
    if len({*sizes}) > 1:
        caveats.append(f"The networks take images of {' and '.join(sizes)} pixels, and differ by that, too.")
    lab = settings.renders(renders, max(network.size for network in networks.values()))
    if page.LABORATORY not in folders:
        try:
            with nullcontext() if renders.exists() and not settings.overwrite else mitsuba():
                folders = {page.LABORATORY: renders} | folders
        except InputError as error:
            caveats.append(f"The laboratory is left out, and look_alikes with it ({error}).")
    for sentence in caveats:
        console.warning(sentence)
    with sole_writer("out", out):
        if settings.overwrite:
            for name in (page.CLASSIFIER, page.HARDENED, renders.name):
                shutil.rmtree(out / name, ignore_errors=True)
        elif (out / CONFIG).exists():
            require_same(out, settings, "out=", lambda key, old, new: old is None and key in ADDED)
        write_config(out, settings, command=shlex.join([*program("audit"), *sys.argv[1:]]))
        if folders.get(page.LABORATORY) == renders:
            _whole(renders, lambda path: write_laboratory(replace(lab, out=str(path))))
        for key, network in networks.items():
            own, (*rest,) = out / key, (other for other in networks.values() if other is not network)
            own.mkdir(exist_ok=True)
            _part(own / page.RECOGNIZED, recognized, network, views, *lights)
            for kind in KINDS:
                _part(own / f"{kind}.json", success_by_light, network, attacked, kind, own)
            for name, folder in folders.items():
                predictor = Predictor(network, network.classes, network.size, device)
                _whole(own / name, partial(_evaluate, predictor, folder, settings.label))
            if rest:
                _part(own / page.TRANSFER, transfers, network, *rest, attacked, own)
        names = {key: network.name for key, network in networks.items()}
        return page.write_audit_page(settings.label, names, folders, out, caveats)


def _own_results(out: Path) -> Collection[str]:
    """The results in a folder that an audit goes on with: all, if it is that of an audit."""
    with suppress(InputError):
        return RESULTS if "look_alikes" in read_config(out / CONFIG) else ()
    return ()


def _part(path: Path, measure: Callable[..., dict[str, Any]], *arguments: Any) -> None:
    """Write what is measured as JSON, unless the file is there."""
    if not path.exists():
        write_whole(path, json.dumps(measure(*arguments)) + "\n", durable=True)


def _evaluate(predictor: Predictor, folder: Path, label: str, out: Path) -> None:
    """Score a network on photographs, but for those that cannot be read."""
    evaluate_photographs(predictor, folder, label, out, skip_unreadable=True)


def _whole(folder: Path, make: Callable[[Path], object]) -> None:
    """Make a folder under another name, which it keeps until it is whole, unless it is there."""
    if not folder.exists():
        unfinished = folder.with_name(f"{folder.name}.part")
        shutil.rmtree(unfinished, ignore_errors=True)
        make(unfinished)
        unfinished.rename(folder)
