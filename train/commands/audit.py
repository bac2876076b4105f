"""pnb-audit and nb.audit: how safe a network is in unusual lighting."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from augment.classifier import UNIT_RANGE, Normalization, TaskNetwork, as_network
from augment.network import device_of, gradient_flags_kept
from augment.settings import NormalizeLight
from augment.tasks.task import Task
from renderer.errors import as_list
from renderer.settings import Size
from train.auditing.audit import run_audit
from train.auditing.network import CLASSIFIER, HARDENED, AuditReport
from train.class_names import MeshItem, as_mappings
from train.command_settings import ENVIRONMENTS, AuditSettings
from train.run_folder import folder_or_temporary


def run(settings: AuditSettings) -> None:
    """Test a network in unusual lighting, and print the main numbers and the path of the report."""
    audited = run_audit(settings)
    print(audited.screen)
    print(f"report: {audited.path}")


def audit(
    network: TaskNetwork | Callable[[Tensor], Any],
    meshes: Sequence[MeshItem],
    label: str | int | None = None,
    *,
    hard_negatives: Sequence[MeshItem] = (),
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
            with or without a class. None for generated fruit and balls.
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
        with folder_or_temporary(out) as folder:
            # `run_audit` takes settings, as the command does, so the arguments become settings.
            items = as_mappings("meshes", meshes)
            negatives = as_mappings("hard_negatives", hard_negatives)
            folders = {"photos": photos, "laboratory": laboratory, "out": folder}
            given: dict[str, Any] = {key: path and str(path) for key, path in folders.items()}
            given |= {"label": label, "meshes": items, "hard_negatives": negatives, "seed": seed}
            given |= {"budget": budget, "device": str(device), "overwrite": overwrite}
            maps = as_list("environments", environments, str, "a list of names")
            settings = AuditSettings(network=networks[CLASSIFIER].name, environments=maps, **given)
            return run_audit(settings, networks).report()
