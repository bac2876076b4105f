"""Text, tables and the figure of an attack."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool
from torch import Tensor

from augment.attacks.result import AttackResult, warnings
from renderer.io.files import atomic_write
from train.results.pictures import COLORS, new_figure, write_figure
from train.results.predictions import SWEEP_FIGURE, SWEEP_TABLE
from train.results.tables import Proportion, Table, format_fraction, fraction, write_csv

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
    # Only examples that were classified correctly before the attack count.
    rate = _success_rate(result.success[clean])
    if rate.n == 0:
        return f"none of {len(clean)} examples was correct before: there is nothing to count"
    text = f"success on {format_fraction(rate)} examples"
    if result.settings.sensor_noise:
        without_noise = int(result.success_without_noise[clean].sum())
        text += f" with a sensor's noise, {without_noise} without"
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
        "log-probability of the right class over all views (less a target's): "
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
        is_correct = torch.tensor(result["clean_correct"])
        rate = _success_rate(torch.tensor(result["success"])[is_correct])
        without_noise = torch.tensor(result[f"success{WITHOUT_NOISE}"])[is_correct].sum()
        lines.append(json.dumps({kind: name, **asdict(rate), **result}) + "\n")
        correct = f"{rate.n} of {len(is_correct)}"
        rows.append([f"{kind} {name}", correct, format_fraction(rate), int(without_noise)])
    atomic_write(path, "".join(lines))
    header = ["adversaries shown to", "correct before", "success", "without noise"]
    return str(Table("", header, rows))


def _success_rate(is_success: Bool[Tensor, " examples"]) -> Proportion:
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
    cells = [[*records[0]], *([*record.values()] for record in records)]
    write_csv(out / SWEEP_TABLE, cells, line_end="\r\n")
    # The last mesh is "all" if there are several.
    last_mesh = records[-1]["mesh"]
    shown = [record for record in records if record["mesh"] == last_mesh and record["n"]]
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
