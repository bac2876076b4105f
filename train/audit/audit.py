"""The parts of an audit: each is measured once, written whole, and read by the page."""

import json
import shutil
from collections.abc import Callable, Collection
from contextlib import nullcontext, suppress
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

from augment.scene.objects import load_object
from augment.settings import ObjectSettings
from renderer.errors import InputError
from renderer.io.files import write_whole
from renderer.io.mitsuba import mitsuba
from renderer.light.presets import UNIFORM, load_light
from train import console
from train.audit import audit_page as page
from train.audit.lights import KINDS, Views, recognized, success_by_light, transfers
from train.command import command_line
from train.command_settings import AuditSettings, LabSettings
from train.commands.results import RESULTS, require_replaceable
from train.data.photographs import FOREIGN, find_photographs
from train.evaluation.laboratory.laboratory import write_laboratory
from train.evaluation.scores.predictions import Predictor
from train.evaluation.scores.scoring import evaluate_photographs
from train.runs.run_folder import CONFIG, read_config, require_same, sole_writer, write_config
from train.runs.saved_networks import load_network
from train.settings import published, read_objects, solid_name
from train.system.device import choose_device
from train.system.user_errors import writable_folder

VIEWS, LIGHTS, ATTACKED, SETUPS = 24, 8, 12, 6  # views, random lights, attacked views, and setups of each pattern
PATTERNS = ("gradient", "rings", "window", "leaves", "text", "colors")  # that training does not throw
SPP = 48  # paths per pixel
ADDED = ("hardened", "photos")  # keys that an audit may be given when it goes on


def audit(settings: AuditSettings) -> None:
    """Make the audit of pnb-audit, and print the path of its page."""
    print(f"report: {run_audit(settings)}")


def run_audit(settings: AuditSettings) -> Path:
    """Measure what is not yet measured in the folder `settings.out`, and write the page; returns its path."""
    device = choose_device(settings.device)
    networks = {page.CLASSIFIER: load_network(settings.classifier, settings.weights).to(device)}
    if settings.hardened:
        networks[page.HARDENED] = load_network(settings.hardened).to(device)
    meshes, others = read_meshes(settings)
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
    lights = [UNIFORM, *settings.environments], settings.scale(LIGHTS)
    views, attacked = (Views(objects, settings.scale(n), settings.seed, device) for n in (VIEWS, ATTACKED))
    out = writable_folder(settings.out, "out")
    require_replaceable(out, "out", settings.overwrite, own=_own_results(out))
    caveats, renders = list[str](), out / "renders"  # an object of the label and another in every light
    sizes = [str(network.size) for network in networks.values()]
    if len({*sizes}) > 1:
        caveats.append(f"The networks take images of {' and '.join(sizes)} pixels, and differ by that, too.")
    lab = laboratory_settings(settings, renders, max(network.size for network in networks.values()))
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
        write_config(out, settings, command=command_line("audit"))
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


def laboratory_settings(settings: AuditSettings, out: Path, size: int) -> LabSettings:
    """Choose the renders of the laboratory: of all patterns and all environments.

    Args:
        settings: Settings of the audit.
        out: Folder of the renders.
        size: Pixels per side.

    Returns:
        Settings of the laboratory.
    """
    objects = [asdict(item) for items in read_meshes(settings) for item in items]
    setups = settings.scale(SETUPS) * (len(PATTERNS) + len(settings.environments))
    return LabSettings(
        out=str(out),
        label=settings.label,
        meshes=objects,
        setups=setups,
        patterns=[*PATTERNS],
        environments=settings.environments,
        size=size,
        spp=SPP,
        seed=settings.seed,
    )


def read_meshes(settings: AuditSettings) -> tuple[list[ObjectSettings], list[ObjectSettings]]:
    """Read the meshes and the look-alikes.

    A look-alike that names no class is of a class that networks may lack.

    Args:
        settings: Settings of the audit.

    Returns:
        The meshes of the label, and the look-alikes.

    Raises:
        InputError: If one is of the wrong class.
    """
    meshes = [*read_objects(settings.meshes, settings.label, "meshes").values()]
    look_alikes = [*read_objects(settings.look_alikes, "", "look_alikes").values()]
    for item in look_alikes:
        item.label = item.label or FOREIGN + (solid_name(item.mesh) or Path(item.mesh).stem)
    for key, items, own in (("meshes", meshes, True), ("look_alikes", look_alikes, False)):
        for item in items:
            if (item.label == settings.label) != own:
                fault = f"{item.mesh} is of the class {item.label}, and label={settings.label}"
                raise InputError(f"{key}: {fault}", key)
    return meshes, look_alikes


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
