"""Text, tables and the figure of an attack."""

import csv
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from jaxtyping import Bool
from torch import Tensor

from augment.attacks.result import AttackResult, warnings
from renderer.io.files import atomic_write
from train.results.pictures import COLORS
from train.results.tables import Proportion, Table, format_fraction, fraction

if TYPE_CHECKING:
    from matplotlib.axes import Axes

TRANSFERS = "transfer.jsonl"
TABLE = "sweep.csv"
FIGURE = "sweep.png"
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

# Result of `nb.success_by_radius`, with a mapping for each radius. It has the radii
# under "radii", and under the name of each method whether it succeeds on each example,
# bool, shape (examples,).
Sweep = Sequence[Mapping[str, Any]]


def format_attack(
    name: str,
    result: AttackResult,
    checks: Mapping[str, Any] | None,
    lines: Sequence[Mapping[str, Any]] = (),
) -> list[str]:
    """Describe the attack on one mesh in lines of text for the console. The first is a summary."""
    has_noise = bool(result.settings.sensor_noise)
    text = [_heading(name, result)]
    if checks is not None:
        text += _check_lines(checks, has_noise, result.settings.uses_gradients)
    adversaries = [line for line in lines if line["success"] and line["clean_correct"]]
    if adversaries:
        for version in adversaries[0]["versions"]:
            text.append(_version_line(version, adversaries, has_noise))
    return text


def _heading(name: str, result: AttackResult) -> str:
    """Write the line that sums up an attack."""
    parameters = "+".join(parameter.name for parameter in result.problem.parameters)
    heading = f"{name}: {parameters} against {result.classifier.name}: {_success(result)}"
    steps = result.steps[result.success & ~result.success_before].double()
    if len(steps):
        heading += f"; median of {steps.median():.0f} steps"
    return f"{heading}; {_passes(result)} ({result.seconds['attack']:.1f} s)"


def _passes(result: AttackResult) -> str:
    """Write the numbers of queries (forward passes) and of backward passes of an attack.

    Backward passes are left out if there are none.
    """
    text = f"{int(result.queries.sum())} queries"
    backward_count = int(result.backward_passes.sum())
    return f"{text}, {backward_count} backward passes" if backward_count else text


def _success(result: AttackResult) -> str:
    """Write on how many examples an attack succeeds.

    Only examples that are classified correctly before the attack count.
    """
    clean = result.clean_correct
    rate = fraction(int(result.success[clean].sum()), int(clean.sum()))
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
    if wrong:
        text += f"; {wrong} wrong before, which do not count"
    return text


def _check_lines(checks: Mapping[str, Any], has_noise: bool, uses_gradients: bool) -> list[str]:
    """Describe the results of the checks of an attack in lines of text."""
    unit = "step" if uses_gradients else "query"
    units = "steps" if uses_gradients else "queries"
    rates_without_noise = checks[f"success_by_steps{WITHOUT_NOISE}"]
    longer_attacks = []
    for steps, rate in checks["success_by_steps"].items():
        rates = _format_rates(rate, rates_without_noise[steps], has_noise)
        longer_attacks.append(f"{rates} in {steps}")
    random_search = _format_rates(
        checks["random_search"], checks[f"random_search{WITHOUT_NOISE}"], has_noise
    )
    zero_gradient = ""
    if uses_gradients:
        zero_gradient = f", without a gradient at the start in {checks['zero_gradient']:.0%}"
    return [
        "log-probability of the right class over all views (less a target's): "
        f"{checks['cost_before']:.2f} before, {checks['cost']:.2f} after; "
        f"lower in {checks['cost_fell']:.0%}{zero_gradient}",
        f"random changes of the same size, one for each {unit}, succeed on {random_search}; "
        f"attacks of more {units}: {', '.join(longer_attacks)}",
        *(f"warning: {warning}" for warning in warnings(checks)),
    ]


def _format_rates(rate: float, without_noise: float, has_noise: bool) -> str:
    """Write a rate in [0, 1] as "62%", or "62% (70% without noise)" if success needs noise."""
    if not has_noise:
        return f"{rate:.0%}"
    return f"{rate:.0%} ({without_noise:.0%} without noise)"


def _version_line(version: str, adversaries: Sequence[Mapping[str, Any]], has_noise: bool) -> str:
    """Write how often adversaries still succeed if their images are made in another way."""
    results = [line["versions"][version] for line in adversaries]
    success = sum(result["success"] for result in results)
    without_noise = ""
    if has_noise:
        count = sum(result[f"success{WITHOUT_NOISE}"] for result in results)
        without_noise = f" ({count} without noise)"
    # Adversaries that fooled the classifier by the margin that the settings ask for.
    with_margin = [line for line in adversaries if line["success_with_margin"]]
    success_with_margin = sum(line["versions"][version]["success"] for line in with_margin)
    largest = 255 * max(result["largest_difference"] for result in results)
    mean = 255 * sum(result["mean_difference"] for result in results) / len(results)
    return (
        f"images as {VERSIONS.get(version, version)}: "
        f"{success} of {len(results)} still succeed{without_noise}, "
        f"{success_with_margin} of the {len(with_margin)} with the margin; "
        f"pixels differ by {mean:.3g}/255 on average, {largest:.3g}/255 at most"
    )


def write_transfers(transfers: Sequence[dict[str, Any]], path: Path) -> str:
    """Write the success of transferred adversaries to a file, and return it as a table.

    The first key of each result, such as "classifier", says what kind of thing it is for.
    """
    lines = []
    rows = []
    for result in transfers:
        is_correct = result["clean_correct"]
        success_count = _count_both(result["success"], is_correct)
        count_without_noise = _count_both(result[f"success{WITHOUT_NOISE}"], is_correct)
        rate = fraction(success_count, sum(is_correct))
        kind = next(iter(result))
        name = result[kind]
        entry = {kind: name, **asdict(rate), **result}
        lines.append(json.dumps(entry) + "\n")
        rows.append(
            [
                f"{kind} {name}",
                f"{rate.n} of {len(is_correct)}",
                format_fraction(rate),
                str(count_without_noise),
            ]
        )
    atomic_write(path, "".join(lines))
    header = ["adversaries shown to", "correct before", "success", "without noise"]
    return str(Table("", header, rows))


def _count_both(is_success: Sequence[bool], is_correct: Sequence[bool]) -> int:
    """Count the examples that are correct before an attack and on which the attack succeeds."""
    pairs = zip(is_success, is_correct, strict=True)
    return sum(success and correct for success, correct in pairs)


def format_sweep(sweep: Sweep) -> str:
    """Write the success of an attack and of a random search at each radius as a table."""
    rows = []
    for row in sweep:
        radii = [f"{name} {radius:g}" for name, radius in row["radii"].items()]
        cells = [" + ".join(radii)]
        for method in METHODS:
            cells.append(format_fraction(_success_rate(row[method])))
            cells.append(str(int(row[method + WITHOUT_NOISE].sum())))
        rows.append(cells)
    header = ["radius"]
    for title in METHODS.values():
        header += [title, "without noise"]
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
        sweeps = {**sweeps, "all": _pool_meshes(sweeps, methods)}
    records = []
    for mesh, sweep in sweeps.items():
        for method in methods:
            for row in sweep:
                rate = asdict(_success_rate(row[method]))
                records.append({"mesh": mesh, "method": method, **row["radii"], **rate})
    text = io.StringIO()
    table = csv.DictWriter(text, list(records[0]))
    table.writeheader()
    table.writerows(records)
    atomic_write(out / TABLE, text.getvalue())
    last_mesh = records[-1]["mesh"]
    shown = [record for record in records if record["mesh"] == last_mesh and record["n"]]
    _draw_sweep(shown, norms, out / FIGURE)


def _pool_meshes(sweeps: Mapping[str, Sweep], methods: Sequence[str]) -> Sweep:
    """Concatenate the examples of all meshes, which have the same radii, at each radius."""
    pooled = []
    for rows in zip(*sweeps.values(), strict=True):
        success = {method: torch.cat([row[method] for row in rows]) for method in methods}
        pooled.append({"radii": rows[0]["radii"], **success})
    return pooled


def _draw_sweep(records: Sequence[Mapping[str, Any]], norms: Mapping[str, str], path: Path) -> None:
    """Draw the success rate of each method against the radius."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5, 3.8), layout="constrained")
    axes = figure.subplots()
    first, *others = norms
    for method in METHODS:
        rows = [record for record in records if record["method"] == method]
        _draw_method(axes, method, rows, first)
    proportional = f"; {' and '.join(others)} in proportion" if others else ""
    axes.set(xscale="log", ylim=(-0.03, 1.03), ylabel="success rate")
    axes.set_xlabel(f"{norms[first]} radius of {first}{proportional}")
    ticks = sorted({record[first] for record in records})
    axes.set_xticks(ticks, [f"{radius:g}" for radius in ticks])
    axes.set_xticks([], minor=True)
    axes.spines[["top", "right"]].set_visible(False)
    if records:
        count = records[0]["n"]
        axes.set_title(f"{count} examples correct before, 95% intervals", fontsize=10)
        figure.legend(loc="outside lower center", ncols=2, frameon=False)
    image = io.BytesIO()
    figure.savefig(image, dpi=150)
    atomic_write(path, image.getbuffer())


def _draw_method(
    axes: "Axes", method: str, rows: Sequence[Mapping[str, Any]], parameter: str
) -> None:
    """Draw the success rate of one method as a line, in a band that is the 95% interval."""
    radii = [row[parameter] for row in rows]
    values = [row["value"] for row in rows]
    color, line, marker = STYLES[method]
    title = METHODS[method]
    axes.plot(radii, values, color=color, linestyle=line, marker=marker, label=title)
    low = [row["low"] for row in rows]
    high = [row["high"] for row in rows]
    axes.fill_between(radii, low, high, color=color, alpha=0.15)
