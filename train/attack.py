"""The attack command: its settings, which are the schema of conf/attack.yaml, the run over meshes, and its output."""

import csv
import io
import json
import re
import shlex
import shutil
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
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
from augment.attacks.evaluate import check, require_transferable, success_by_radius, transfer, warnings
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
from renderer.io.files import write_whole
from train.device import choose_device
from train.errors import writable_folder
from train.results import require_replaceable
from train.run_folder import sole_writer, write_config
from train.settings import LARGEST_SEED, chosen_rasterizer, keyed, program, read_object
from train.tables import Proportion, Table, format_fraction, fraction

TRANSFERS, TABLE, FIGURE = "transfer.jsonl", "sweep.csv", "sweep.png"
NAMES = {"float": "computed", "reload": "rendered again from the saved files", "mitsuba": "rendered by Mitsuba"}
METHODS = {"adversarial": "adversarial", "random": "random search, as many renders"}
WITHOUT_NOISE = "_without_noise"  # ends the keys of what counts without a sensor's noise
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
    sweeps: dict[str, list[dict[str, Any]]] = {}
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


def format_attack(
    name: str, result: AttackResult, checks: Mapping[str, Any] | None, lines: Sequence[Mapping[str, Any]] = ()
) -> str:
    """A paragraph on one mesh's attack, without a newline at the end. lines: as `augment.save` returns them."""
    parameters = "+".join(parameter.name for parameter in result.problem.parameters)
    steps = result.steps[result.success & ~result.success_before].double()
    median = f"; median of {steps.median():.0f} steps" if len(steps) else ""
    heading = f"{name}: {parameters} against {result.classifier.name}"
    text = [f"{heading}: {_success(result)}{median} ({result.seconds['attack']:.1f} s)"]
    if checks is not None:
        without = checks[f"success_by_steps{WITHOUT_NOISE}"]
        by_steps = ", ".join(
            f"{_rate_of_both(rate, without[steps], result.settings)} in {steps}"
            for steps, rate in checks["success_by_steps"].items()
        )
        search = checks["random_search"], checks[f"random_search{WITHOUT_NOISE}"]
        text += [
            "log-probability of the right class over all views (less a target's): {cost_before:.2f} before, {cost:.2f} "
            "after; lower in {cost_fell:.0%}, without a gradient at the start in {zero_gradient:.0%}".format(**checks),
            "random changes of the same size, one for each step, succeed on "
            f"{_rate_of_both(*search, result.settings)}; attacks of more steps: {by_steps}",
            *(f"warning: {warning}" for warning in warnings(checks)),
        ]
    adversaries = [line for line in lines if line["success"] and line["clean_correct"]]
    for version in adversaries[0]["versions"] if adversaries else ():
        numbers = [line["versions"][version] for line in adversaries]
        as_they_are = sum(line[f"success{WITHOUT_NOISE}"] for line in numbers)
        without_noise = f" ({as_they_are} without noise)" if result.settings.sensor_noise else ""
        by_margin = [line["versions"][version]["success"] for line in adversaries if line["success_with_margin"]]
        largest = 255 * max(line["largest_difference"] for line in numbers)
        mean = 255 * sum(line["mean_difference"] for line in numbers) / len(numbers)
        text.append(
            f"images as {NAMES.get(version, version)}: {sum(line['success'] for line in numbers)} of {len(numbers)} "
            f"still succeed{without_noise}, {sum(by_margin)} of the {len(by_margin)} with the margin; pixels differ by "
            f"{mean:.3g}/255 on average, {largest:.3g}/255 at most"
        )
    return "\n".join(text)


def _rate_of_both(rate: float, without_noise: float, settings: AttackSettings) -> str:
    """A fraction of successes and, where a sensor's noise counts, that without it."""
    return f"{rate:.0%}" + (f" ({without_noise:.0%} without noise)" if settings.sensor_noise else "")


def _success(result: AttackResult) -> str:
    """On clean-correct examples, and on their views, with the 95 % Wilson interval."""
    clean = result.clean_correct
    rate = fraction(int(result.success[clean].sum()), int(clean.sum()))
    if rate.n == 0:
        return f"none of {len(clean)} examples was correct before: there is nothing to count"
    views, wrong = result.success_in_views[clean], int((~clean).sum())
    text, by_margin = f"success on {format_fraction(rate)} examples", int(result.success_with_margin[clean].sum())
    if result.settings.sensor_noise:
        text += f" with a sensor's noise, {int(result.success_without_noise[clean].sum())} without"
    text += f", {by_margin} with the margin of {result.settings.margin:g}" if result.settings.margin else ""
    text += f", {int(views.sum())} of {views.numel()} views" if views.shape[1] > 1 else ""
    return text + (f"; {wrong} wrong before, which do not count" if wrong else "")


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


def write_transfers(transfers: Sequence[dict[str, Any]], path: Path) -> str:
    """Write a line for each result of `augment.transfer`, with the success rate; returns the rates as a table."""
    lines, rows = [], []
    for found in transfers:
        clean = found["clean_correct"]
        rate = fraction(_count_correct(found["success"], clean), sum(clean))
        kind = next(iter(found))
        lines.append(json.dumps({kind: found[kind], **asdict(rate), **found}) + "\n")
        without_noise = _count_correct(found[f"success{WITHOUT_NOISE}"], clean)
        numbers = [f"{rate.n} of {len(clean)}", format_fraction(rate), without_noise]
        rows.append([f"{kind} {found[kind]}", *map(str, numbers)])
    write_whole(path, "".join(lines))
    header = ["adversaries shown to", "correct before", "success", "without noise"]
    return str(Table("", header, rows))


def _count_correct(success: Sequence[bool], clean: Sequence[bool]) -> int:
    """How many of the examples that were correct before are a success."""
    return sum(hit for hit, correct in zip(success, clean, strict=True) if correct)


def format_sweep(sweep: Sequence[Mapping[str, Any]]) -> str:
    """A result of `augment.success_by_radius`, a line per radius."""
    rows = []
    for row in sweep:
        radii = " + ".join(f"{name} {radius:g}" for name, radius in row["radii"].items())
        counts = (format_fraction(_rate(row[method])) for method in METHODS)
        without_noise = (str(int(row[method + WITHOUT_NOISE].sum())) for method in METHODS)
        cells = [cell for pair in zip(counts, without_noise, strict=True) for cell in pair]
        rows.append([radii, *cells])
    titles = [title for method in METHODS.values() for title in (method, "without noise")]
    return str(Table("", ["radius", *titles], rows))


def _rate(success: Tensor) -> Proportion:
    return fraction(int(success.sum()), len(success))


def write_sweeps(sweeps: Mapping[str, Sequence[Mapping[str, Any]]], norms: Mapping[str, str], out: Path) -> None:
    """sweep.csv, a line per mesh (and all of several), method (also without noise) and radius, with the success rate on
    examples that were correct before and its 95 % Wilson interval; and sweep.png, of the last mesh or of all. norms: by
    parameter."""
    methods = [method + end for end in ("", WITHOUT_NOISE) for method in METHODS]
    if len(sweeps) > 1:
        pooled = [
            {"radii": rows[0]["radii"], **{method: torch.cat([row[method] for row in rows]) for method in methods}}
            for rows in zip(*sweeps.values(), strict=True)
        ]
        sweeps = {**sweeps, "all": pooled}
    records = [
        {"mesh": mesh, "method": method, **row["radii"], **asdict(_rate(row[method]))}
        for mesh, sweep in sweeps.items()
        for method in methods
        for row in sweep
    ]
    text = io.StringIO()
    table = csv.DictWriter(text, list(records[0]))
    table.writeheader()
    table.writerows(records)
    write_whole(out / TABLE, text.getvalue())
    _draw([record for record in records if record["mesh"] == records[-1]["mesh"] and record["n"]], norms, out / FIGURE)


def _draw(records: Sequence[Mapping[str, Any]], norms: Mapping[str, str], path: Path) -> None:
    from matplotlib.figure import Figure

    from train.report.plots import COLORS, LINES, MARKERS

    figure = Figure(figsize=(5, 3.8), layout="constrained")
    axes, (first, *others) = figure.subplots(), norms
    for (method, name), color, line, marker in zip(METHODS.items(), COLORS, LINES[1::-1], MARKERS, strict=False):
        rows = [record for record in records if record["method"] == method]
        radii, value, low, high = ([row[key] for row in rows] for key in (first, "value", "low", "high"))
        axes.plot(radii, value, color=color, linestyle=line, marker=marker, label=name)
        axes.fill_between(radii, low, high, color=color, alpha=0.15)
    proportional = f"; {' and '.join(others)} in proportion" if others else ""
    axes.set(xscale="log", ylim=(-0.03, 1.03), ylabel="success rate")
    axes.set_xlabel(f"{norms[first]} radius of {first}{proportional}")
    ticks = sorted({record[first] for record in records})
    axes.set_xticks(ticks, [f"{radius:g}" for radius in ticks])
    axes.set_xticks([], minor=True)
    axes.spines[["top", "right"]].set_visible(False)
    if records:
        axes.set_title(f"{records[0]['n']} examples correct before, 95 % intervals", fontsize=10)
        figure.legend(loc="outside lower center", ncols=2, frameon=False)
    image = io.BytesIO()
    figure.savefig(image, dpi=150)
    write_whole(path, image.getbuffer())
