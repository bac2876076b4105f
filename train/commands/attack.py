"""pnb-attack: attack each mesh of a scene, or continue from a saved adversary.

An adversary is an attacked scene that the classifier misclassifies. Its files can
be loaded again with reload=FOLDER.
"""

import json
import shlex
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple
from warnings import catch_warnings, filterwarnings

import torch
from jaxtyping import Bool

from augment.attack_settings import AttackSettings, RelightingSettings
from augment.attacks.adversary import Adversary, reload
from augment.attacks.attack import attack, find_scene
from augment.attacks.checks import check, require_transferable, resized, success_by_radius, transfer
from augment.attacks.files import require_renderers, save
from augment.attacks.objective import Objective
from augment.attacks.result import ZERO_GRADIENT, AttackResult, warnings
from augment.classifier import Classifier, TaskNetwork
from augment.network import device_of
from augment.random_streams import generator
from augment.scene.build import build_scene
from augment.scene.objects import add_table, load_object
from augment.scene.scene import Scene
from augment.settings import ObjectSettings
from augment.tasks.task import NO_CLASS
from renderer.errors import InputError, keyed, keys_of
from renderer.io.files import atomic_write
from renderer.settings import Size
from renderer.visibility import Rasterizer
from train import console
from train.auditing.lights import criterion_of
from train.auditing.relit import MODELED, attack_folder
from train.checkpoints import load_chosen, load_network, with_task
from train.class_names import class_of_meshes
from train.command_settings import AttackExperimentSettings, AttackSceneSettings
from train.device import choose_device, choose_rasterizer
from train.results.overwrite import output_folder, remove_attack
from train.results.pictures import COLORS, new_figure, write_figure
from train.results.predictions import RELIT, SWEEP_FIGURE, SWEEP_TABLE, TRANSFERS
from train.results.tables import Proportion, Table, format_fraction, fraction, write_csv
from train.run_config import write_config
from train.run_folder import sole_writer
from train.settings import published_folder, read_objects
from train.system import command_line, is_verbose, shortened

# Warnings about at most 3 unreadable files are printed if --verbose is not set.
MAX_UNREADABLE = 3
# Versions of the images of an adversary: the words say how they were made. attack.jsonl
# has results for each version.
VERSIONS = {
    "float": "computed",
    "reload": "rendered again from the saved files",
    "mitsuba": "rendered by Mitsuba",
}
# Titles of the two methods whose success is compared at each radius.
METHODS = {"adversarial": "adversarial", "random": "random search, as many renders"}
# Color, line style and marker of the attack and of the random search in the figure.
STYLES = {"adversarial": (COLORS[0], "-", "o"), "random": (COLORS[1], "--", "s")}
# Suffix of the names of results on images without the simulated noise of a sensor.
WITHOUT_NOISE = "_without_noise"

# A line of attack.jsonl about an example.
Line = Mapping[str, Any]
# Result of `nb.success_by_radius`, with a mapping for each radius. It has the radii
# under "radii", and under the name of each method whether it succeeds on each example,
# bool, shape (examples,).
Sweep = Sequence[Mapping[str, Any]]


def run(settings: AttackExperimentSettings) -> None:
    """Run pnb-attack: attack meshes, write the results, and print a summary.

    If the settings name photographs, their lighting is attacked instead. With
    `settings.reload`, the predictions for a saved adversary are printed, and
    the attack, if there is one, starts at this adversary.
    """
    if settings.attack.relighting is not None:
        _attack_photographs(settings, settings.attack.relighting)
        return
    # These settings are checked before any file is read.
    with keyed("transfer", **keys_of("transfer", settings.transfer)):
        moved = settings.transfer.azimuths, settings.transfer.meshes
        require_transferable(settings.attack.parameters, *moved)
    adversary = reload(settings.reload) if settings.reload else None
    with keyed("attack", **keys_of("attack", settings.attack)):
        require_renderers(settings.attack.renderers)
        if adversary is None:
            settings.attack.require_parameters()
    device = choose_device(settings.device)
    classifier = load_chosen(settings).to(device)
    if adversary is not None:
        rasterizer = choose_rasterizer(settings.renderer)
        views = format_reloaded(adversary, rasterizer, classifier, settings.attack)
        print("\n".join(shortened(views)))
        if not settings.attack.parameters:
            return
    targets = load_targets(settings, classifier)
    with _results_of(settings, classifier) as out, catch_warnings():
        if settings.attack.checks is not False:
            # The checks say this for each mesh.
            filterwarnings("ignore", ZERO_GRADIENT)
        attacked = []
        sweeps: dict[str, Sweep] = {}
        for index, (name, scene, result) in enumerate(attacks(settings, classifier, adversary)):
            # The name of a solid has colons, which Windows does not allow in file names.
            folder = out / f"{index}_{Path(name.replace(':', '_')).stem}"
            mesh = _write_attack(name, scene, result, folder, settings, targets)
            if settings.attack.radius_scales:
                sweeps[folder.name] = success_by_radius(result, settings.attack.radius_scales)
            if is_verbose():
                print("\n".join([mesh.heading, *mesh.details, ""]))
            attacked.append(mesh)
        if not is_verbose():
            details = [line for mesh in attacked for line in mesh.details]
            print("\n".join(shortened([*_headings(attacked), *details])))
        if sweeps:
            norms = {name: steps.norm for name, steps in settings.attack.parameters.items()}
            write_sweeps(sweeps, norms, out)
            print(f"success against radius: {out / SWEEP_TABLE} and {out / SWEEP_FIGURE}")
    print(f"images, adversaries and numbers: {out}")


class _AttackedMesh(NamedTuple):
    """Row of an attacked mesh in a table, and lines about it for the console.

    The row has its name, and the numbers of its examples, of those that were classified correctly
    before the attack, and of successes among these.
    """

    row: tuple[str, int, int, int]
    heading: str
    details: list[str]


def _headings(attacked: Sequence[_AttackedMesh]) -> list[str]:
    """Return the heading of a mesh, or the sum and a table of several."""
    if len(attacked) < 2:
        return [mesh.heading for mesh in attacked]
    rows = [mesh.row for mesh in attacked]
    _, _, correct, successes = zip(*rows, strict=True)
    total = f"success on {sum(successes)} of {sum(correct)} examples that were correct before"
    table = Table("", ["mesh", "examples", "correct before", "success"], rows)
    return [f"{len(rows)} meshes: {total}", *str(table).splitlines()]


@contextmanager
def _results_of(settings: AttackExperimentSettings, classifier: Classifier) -> Iterator[Path]:
    """Yield the empty folder of the results, and write config.yaml at the end of the block."""
    out = output_folder(settings.out, settings.overwrite)
    with sole_writer(out):
        remove_attack(out)
        yield out
        images = classifier.describe_inputs()
        write_config(out, settings, command=command_line("attack"), images=images)


def _write_attack(
    name: str,
    scene: AttackSceneSettings,
    result: AttackResult,
    folder: Path,
    settings: AttackExperimentSettings,
    targets: Mapping[str, Any],
) -> _AttackedMesh:
    """Check and write the attack on one mesh."""
    details = []
    # The search chose another scene than the given one, in which the network was wrong already.
    if scene != settings.scene:
        before = vars(settings.scene)
        changed = [item for item in vars(scene).items() if item[1] != before[item[0]]]
        changes = shlex.join(f"scene.{key}={value}" for key, value in changed)
        details.append(f"{name} is misclassified in the given scene, but not with {changes}")
    # With None, only attacks that use gradients are checked.
    wanted = settings.attack.checks
    has_checks = result.settings.uses_gradients if wanted is None else wanted
    checks = check(result) if has_checks else None
    lines = save(result, folder, checks, settings.attack.renderers)
    heading, *more_lines = format_attack(name, result, checks, lines)
    if is_verbose():
        details += [*more_lines, f"images, adversaries and numbers: {folder}"]
    elif checks:
        details += [f"warning about {name}: {text}" for text in warnings(checks)]
    # Adversaries are shown to other networks, from other sides and on other meshes.
    if any(targets.values()):
        details += write_transfers(transfer(result, **targets), folder / TRANSFERS).splitlines()
    correct = result.clean_correct
    row = (name, len(correct), int(correct.sum()), int(result.success[correct].sum()))
    return _AttackedMesh(row, heading, details)


def attacks(
    settings: AttackExperimentSettings, classifier: Classifier, adversary: Adversary | None = None
) -> Iterator[tuple[str, AttackSceneSettings, AttackResult]]:
    """Attack each mesh of the settings, or the scene of a saved adversary.

    Yield the name of each mesh, the settings of the attacked scene, and the result. If a mesh is
    misclassified in its scene, a search looks for another scene in which it is recognized, unless
    `scene.search` is 0 or `attack.force` is set. The values of an adversary are the start of its
    attack and the centers of the norm-balls.
    """

    def start(scene: Scene, force: bool) -> AttackResult:
        with keyed("attack", **keys_of("attack", settings.attack)):
            # The target class and the settings of the attack.
            given = settings.target, settings.attack
            return attack(classifier, scene, *given, seed=settings.seed, force=force)

    if adversary is not None:
        if adversary.pixels is not None:
            raise InputError(f"reload={settings.reload} has changed pixels: give another")
        if settings.attack.skylight:
            line = "the sky starts at attack.skylight: give it the values of sky in attack.jsonl"
            console.warning(line)
        # An attack on the pose needs them, and images stay the same.
        silhouettes = adversary.settings.silhouettes or settings.renderer.silhouettes
        shown = replace(adversary.settings, silhouettes=silhouettes)
        adversary = replace(adversary, settings=shown)
        adversary = resized(adversary, classifier.size or adversary.settings.size)
        # The saved adversary has its own scene, which may be misclassified already.
        device = choose_device(settings.device)
        scene = adversary.scene(choose_rasterizer(settings.renderer), device)
        yield adversary.shown.name, settings.scene, start(scene, force=True)
        return
    for mesh in _labeled(settings, classifier.classes):
        build = partial(build_attacked, settings, mesh, size=classifier.size)
        chosen = settings.scene
        try:
            result = start(build(chosen), settings.attack.force)
        except InputError as error:
            # The attack has rendered the scene, and found the mesh misclassified in it. `search` is
            # the number of cameras that the search for a recognized view tries.
            if error.argument != "attack.force" or not chosen.search:
                raise
            draws = generator(settings.seed, mesh.mesh, "search")
            arguments = classifier, chosen, settings.attack, build, chosen.search, draws
            chosen, scene = find_scene(*arguments)
            result = start(scene, force=False)
        yield mesh.mesh, chosen, result


def build_attacked(
    settings: AttackExperimentSettings, item: ObjectSettings, scene: AttackSceneSettings, size: Size
) -> Scene:
    """Build the scene in which one mesh is attacked.

    With `attack.shared`, one attack must succeed in all views, so the scene has
    one example for each background. Otherwise it has one example for each pair
    of a view and a background.
    """
    options: dict[str, Any] = {"scene": scene, "device": choose_device(settings.device)}
    options |= {"attack": settings.attack, "shared": settings.attack.shared}
    options |= {"renderer": settings.renderer, "rasterizer": choose_rasterizer(settings.renderer)}
    with keyed("scene", **keys_of("scene", scene)):
        return build_scene([item], size, scene.views, **options)


def _labeled(settings: AttackExperimentSettings, classes: Sequence[str]) -> list[ObjectSettings]:
    """Read the meshes of the settings. Each has a label of its own, that of all or its name."""
    meshes = read_objects(settings.meshes, "", "meshes")
    for (key, mesh), item in zip(meshes.items(), settings.meshes, strict=True):
        mesh.label = class_of_meshes([item], classes, key, mesh.label or settings.label)
    return [*meshes.values()]


def load_targets(settings: AttackExperimentSettings, attacked: Classifier) -> dict[str, Any]:
    """Load the other classifiers and meshes with which successful attacks are tested.

    Return the arguments of `nb.transfer`.
    """
    chosen = settings.transfer
    label = ""
    if chosen.meshes:
        label = class_of_meshes(settings.meshes, attacked.classes, "meshes", settings.label)
    classifiers = []
    for item in chosen.networks:
        values = item if isinstance(item, dict) else {"network": item}
        if values.keys() - {"network", "weights"}:
            raise InputError(f"transfer.networks has {item}: give a name, or {{network, weights}}")
        name = str(values.get("network"))
        with keyed(name="transfer.networks", weights="transfer.networks: weights"):
            other = load_network(name, values.get("weights"), trust_code=settings.trust)
        if other.task.name == attacked.task.name:
            other = with_task(other, settings)
        # Classes are compared by name, because their indices may differ in other classifiers.
        # `label` raises an InputError if the classifier lacks the class.
        for mesh in _labeled(settings, attacked.classes):
            other.label(mesh.label)
        classifiers.append(other.to(choose_device(settings.device)))
    objects = []
    for mesh in read_objects(chosen.meshes, label, "transfer.meshes").values():
        # A mesh with a class that the attacked network lacks raises InputError.
        attacked.label(mesh.label)
        item = load_object(mesh, settings.scene.vertices, settings.renderer.encoding)
        objects.append(add_table(item, settings.scene.ground))
    return {"classifiers": classifiers, "azimuths": chosen.azimuths, "objects": objects}


def format_reloaded(
    adversary: Adversary, rasterizer: Rasterizer, classifier: TaskNetwork, settings: AttackSettings
) -> list[str]:
    """Render a reloaded adversary again, and describe what a network finds in its views.

    Each line has the prediction, and the largest difference from the saved image. A network of
    another size gets a render of that size.
    """
    device = device_of(classifier)
    saved = adversary.images_in_views
    adversary = resized(adversary, classifier.size or adversary.settings.size)
    images = adversary.render_views(rasterizer).to(device)
    label = adversary.shown.label
    # A classifier need not know the class.
    known = NO_CLASS if isinstance(classifier, Classifier) else classifier.label(label)
    criterion = criterion_of(classifier, adversary.scene(rasterizer, device), known)
    # `images[None]` is one example with V views. Evidence has the shape (1, V, K).
    evidence = Objective(classifier, criterion, settings, seed=0).evidence(images[None])
    height, width = images.shape[-2:]
    compared = [f"rendered again at {height} × {width} pixels"] * len(images)
    if images.shape == saved.shape:
        levels = (255 * (images - saved.to(images)).abs().flatten(1).amax(1)).tolist()
        compared = [f"values differ from those saved by {one:.3g}/255 at most" for one in levels]
    named = classifier.task.found(evidence[0], criterion.predicted(evidence)[0], classifier.classes)
    return [
        f"view {view}: {label} is recognized as {named['predicted'][view]} "
        f"({named['confidence'][view]:.1%}); {comparison}"
        for view, comparison in enumerate(compared)
    ]


def _attack_photographs(settings: AttackExperimentSettings, relighting: RelightingSettings) -> None:
    """Attack a network by the light of a projector on photographs, and print the results."""
    classifier = load_chosen(settings).to(choose_device(settings.device))
    photographs = published_folder(Path(str(settings.unlabeled)))
    options: dict[str, Any] = {"seed": settings.seed, "batch_size": settings.attack.batch_size}
    options["sensor_noise"] = settings.attack.sensor_noise
    with _results_of(settings, classifier) as out, keyed("unlabeled"):
        found = attack_folder(classifier, photographs, relighting, out, **options)
    # The first table is about all photographs, and the second about each predicted class.
    print(f"{found.tables()[0]}\n\n{MODELED}\n")
    unreadable = [f"warning: {path} cannot be read" for path in found.unreadable]
    for line in shortened(unreadable, MAX_UNREADABLE):
        print(line)
    print(f"predictions and pictures: {out / RELIT}")


def format_attack(
    name: str, result: AttackResult, checks: Mapping[str, Any] | None, lines: Sequence[Line]
) -> list[str]:
    """Describe the attack on one mesh in lines of text for the console. The first is a summary."""
    parameters = "+".join(parameter.name for parameter in result.problem.parameters)
    heading = f"{name}: {parameters} against {result.classifier.name}: {_success(result)}"
    # Steps of the examples that the attack itself changed.
    steps = result.steps[result.success & ~result.success_before].double()
    if len(steps):
        heading += f"; median of {steps.median():.0f} steps"
    backward_count = int(result.backward_passes.sum())
    backward = f", {backward_count} backward passes" if backward_count else ""
    queries = f"{int(result.queries.sum())} queries{backward}"
    text = [f"{heading}; {queries} ({result.seconds['attack']:.1f} s)"]
    if checks is not None:
        text += _check_lines(checks, result.settings.uses_gradients)
    # Versions are other ways to make the images, such as another renderer.
    adversaries = [line for line in lines if line["success"] and line["clean_correct"]]
    versions = adversaries[0]["versions"] if adversaries else ()
    return text + [_version_line(version, adversaries) for version in versions]


def _success(result: AttackResult) -> str:
    """Write on how many examples an attack succeeds, of those classified correctly before."""
    clean = result.clean_correct
    rate = _success_rate(result.success[clean])
    if rate.n == 0:
        return f"none of {len(clean)} examples was correct before: there is nothing to count"
    text = f"success on {format_fraction(rate)} examples"
    if result.settings.sensor_noise:
        text += f" with a sensor's noise, {int(result.success_without_noise[clean].sum())} without"
    margin = result.settings.margin
    if margin:
        text += f", {int(result.success_with_margin[clean].sum())} with the margin of {margin:g}"
    views = result.success_in_views[clean]
    if views.shape[1] > 1:
        text += f", {int(views.sum())} of {views.numel()} views"
    wrong = int((~clean).sum())
    return f"{text}; {wrong} wrong before, which do not count" if wrong else text


def _check_lines(checks: Mapping[str, Any], uses_gradients: bool) -> list[str]:
    """Describe the results of the checks of an attack in lines of text."""
    unit, units = ("step", "steps") if uses_gradients else ("query", "queries")
    # Success rates of attacks with several numbers of steps.
    attacks = [f"{rate:.0%} in {count}" for count, rate in checks["success_by_steps"].items()]
    zero_gradient = ""
    if uses_gradients:
        zero_gradient = f", without a gradient at the start in {checks['zero_gradient']:.0%}"
    # A cost is lower after the attack if the network is less sure of the right class.
    return [
        "cost (of a classifier, the log-probability of the right class over all views, less a "
        "target's): "
        f"{checks['cost_before']:.2f} before, {checks['cost']:.2f} after; "
        f"lower in {checks['cost_fell']:.0%}{zero_gradient}",
        f"random changes of the same size, one for each {unit}, succeed on "
        f"{checks['random_search']:.0%}; attacks of more {units}: {', '.join(attacks)}",
        *(f"warning: {warning}" for warning in warnings(checks)),
    ]


def _version_line(version: str, adversaries: Sequence[Line]) -> str:
    """Write how often adversaries still succeed if their images are made in another way."""
    results = [line["versions"][version] for line in adversaries]
    # Adversaries that fooled the classifier by the margin that the settings ask for.
    with_margin = [line["versions"][version] for line in adversaries if line["success_with_margin"]]
    counts = [sum(item["success"] for item in group) for group in (results, with_margin)]
    largest = 255 * max(item["largest_difference"] for item in results)
    mean = 255 * sum(item["mean_difference"] for item in results) / len(results)
    succeed = f"{counts[0]} of {len(results)} still succeed"
    of_margin = f"{counts[1]} of the {len(with_margin)} with the margin"
    differ = f"pixels differ by {mean:.3g}/255 on average, {largest:.3g}/255 at most"
    return f"images as {VERSIONS.get(version, version)}: {succeed}, {of_margin}; {differ}"


def write_transfers(transfers: Sequence[dict[str, Any]], path: Path) -> str:
    """Write the success of transferred adversaries to a file, and return it as a table.

    The first key of each result, such as "classifier", says what kind of thing it is for.
    """
    lines = []
    rows = []
    for result in transfers:
        # Such as "classifier" and "resnet50".
        kind, name = next(iter(result.items()))
        is_correct = torch.tensor(result["clean_correct"], dtype=torch.bool)
        rate = _success_rate(torch.tensor(result["success"], dtype=torch.bool)[is_correct])
        without_noise = torch.tensor(result[f"success{WITHOUT_NOISE}"])[is_correct].sum()
        lines.append(json.dumps({kind: name, **asdict(rate), **result}) + "\n")
        correct = f"{rate.n} of {len(is_correct)}"
        rows.append([f"{kind} {name}", correct, format_fraction(rate), int(without_noise)])
    atomic_write(path, "".join(lines))
    header = ["adversaries shown to", "correct before", "success", "without noise"]
    return str(Table("", header, rows))


def _success_rate(is_success: Bool[torch.Tensor, " examples"]) -> Proportion:
    """Compute the fraction of examples on which an attack succeeds, with its interval."""
    return fraction(int(is_success.sum()), len(is_success))


def write_sweeps(sweeps: Mapping[str, Sweep], norms: Mapping[str, str], out: Path) -> None:
    """Write the success at each radius as a table, sweep.csv, and as a figure, sweep.png.

    A row of the table has the success rate of one method at one radius on the
    examples of one mesh, with its 95% Wilson interval. Only examples that are
    classified correctly before the attack count. With several meshes, rows with
    the mesh "all" have the examples of all meshes together. The figure shows
    these rows, or else the rows of the only mesh.
    """
    methods = [method + end for end in ("", WITHOUT_NOISE) for method in METHODS]
    if len(sweeps) > 1:
        pooled = []
        # All meshes have the same radii.
        for rows in zip(*sweeps.values(), strict=True):
            success = {method: torch.cat([row[method] for row in rows]) for method in methods}
            pooled.append({"radii": rows[0]["radii"], **success})
        sweeps = {**sweeps, "all": pooled}
    records = [
        {"mesh": mesh, "method": method, **row["radii"], **asdict(_success_rate(row[method]))}
        for mesh, sweep in sweeps.items()
        for method in methods
        for row in sweep
    ]
    # The header, and a row for each record.
    write_csv(out / SWEEP_TABLE, [records[0], *map(dict.values, records)], line_end="\r\n")
    # The last mesh is "all" if there are several.
    shown = [record for record in records if record["mesh"] == records[-1]["mesh"] and record["n"]]
    _draw_sweep(shown, norms, out / SWEEP_FIGURE)


def _draw_sweep(records: Sequence[Mapping[str, Any]], norms: Mapping[str, str], path: Path) -> None:
    """Draw the success rate of each method against the radius, in a band that is its interval."""
    figure, axes = new_figure((5, 3.8))
    # The radii of all parameters change in proportion, so the axis shows the first one.
    first, *others = norms
    for method, title in METHODS.items():
        rows = [record for record in records if record["method"] == method]
        columns = (first, "value", "low", "high")
        radii, values, low, high = ([row[name] for row in rows] for name in columns)
        color, line, marker = STYLES[method]
        axes.plot(radii, values, color=color, linestyle=line, marker=marker, label=title)
        axes.fill_between(radii, low, high, color=color, alpha=0.15)
    proportional = f"; {' and '.join(others)} in proportion" if others else ""
    axes.set(xscale="log", ylim=(-0.03, 1.03), ylabel="success rate")
    axes.set_xlabel(f"{norms[first]} radius of {first}{proportional}")
    ticks = sorted({record[first] for record in records})
    axes.set_xticks(ticks, [f"{radius:g}" for radius in ticks])
    axes.set_xticks([], minor=True)
    axes.spines[["top", "right"]].set_visible(False)
    if records:
        axes.set_title(f"{records[0]['n']} examples correct before, 95% intervals", fontsize=10)
        figure.legend(loc="outside lower center", ncols=2, frameon=False)
    write_figure(path, figure, dpi=150)
