"""Text, tables and the figure of an attack."""

import csv
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from augment.attacks.attack import AttackResult
from augment.attacks.checks import warnings
from renderer.io.files import atomic_write
from train.evaluation.tables import Proportion, Table, format_fraction, fraction
from train.report.plots import COLORS, LINES, MARKERS

TRANSFERS = "transfer.jsonl"
TABLE = "sweep.csv"
FIGURE = "sweep.png"
# Origin of the images of each version of an adversary, in words.
VERSIONS = {
    "float": "computed",
    "reload": "rendered again from the saved files",
    "mitsuba": "rendered by Mitsuba",
}
# Titles of the methods that are compared at each radius.
METHODS = {"adversarial": "adversarial", "random": "random search, as many renders"}
# End of the names of results that are measured in images without a sensor's noise.
WITHOUT_NOISE = "_without_noise"

# Result of `nb.success_by_radius`: at each radius, whether each method
# succeeds on each example.
Sweep = Sequence[Mapping[str, Any]]


def format_attack(
    name: str,
    result: AttackResult,
    checks: Mapping[str, Any] | None,
    lines: Sequence[Mapping[str, Any]] = (),
) -> list[str]:
    """Write the success, the checks and the adversaries of the attack on one mesh.

    Args:
        name: Name of the mesh.
        result: Result of `nb.attack`.
        checks: Result of `nb.check`. None if nothing was checked.
        lines: Lines of attack.jsonl, as `nb.save` returns them.

    Returns:
        Lines. The first one says how often the attack succeeds.
    """
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
    """Write the first line about an attack.

    Args:
        name: Name of the mesh.
        result: Result of the attack.

    Returns:
        The attacked parameters, the classifier, the rate of success, the median
        number of steps of the successes, the passes and the seconds.
    """
    parameters = "+".join(parameter.name for parameter in result.problem.parameters)
    heading = f"{name}: {parameters} against {result.classifier.name}: {_success(result)}"
    steps = result.steps[result.success & ~result.success_before].double()
    if len(steps):
        heading += f"; median of {steps.median():.0f} steps"
    return f"{heading}; {_passes(result)} ({result.seconds['attack']:.1f} s)"


def _passes(result: AttackResult) -> str:
    """Count the forward passes of an attack and, if there are any, its backward passes."""
    text = f"{int(result.queries.sum())} queries"
    backward_count = int(result.backward_passes.sum())
    return f"{text}, {backward_count} backward passes" if backward_count else text


def _success(result: AttackResult) -> str:
    """Count the successes of an attack.

    Only examples count that are classified correctly before the attack.

    Args:
        result: Result of the attack on E examples of V views.

    Returns:
        Text with the number of examples with a success. If noise, a margin or
        several views were asked for, the numbers without noise, with the margin
        and for single views follow.
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
    """Write the results of the checks of an attack.

    Args:
        checks: Result of `nb.check`.
        has_noise: Whether a success must remain with a sensor's noise.
        uses_gradients: Whether the attack takes steps along a gradient.
            Otherwise its budget counts queries.

    Returns:
        Lines about the log-probability before and after the attack, about
        random changes and longer attacks, and about doubts.
    """
    unit = "step" if uses_gradients else "query"
    units = "steps" if uses_gradients else "queries"
    rates_without_noise = checks[f"success_by_steps{WITHOUT_NOISE}"]
    rates = []
    for steps, rate in checks["success_by_steps"].items():
        rates.append(f"{_both_rates(rate, rates_without_noise[steps], has_noise)} in {steps}")
    search_without_noise = checks[f"random_search{WITHOUT_NOISE}"]
    search = _both_rates(checks["random_search"], search_without_noise, has_noise)
    zero_gradient = ""
    if uses_gradients:
        zero_gradient = f", without a gradient at the start in {checks['zero_gradient']:.0%}"
    return [
        "log-probability of the right class over all views (less a target's): "
        f"{checks['cost_before']:.2f} before, {checks['cost']:.2f} after; "
        f"lower in {checks['cost_fell']:.0%}{zero_gradient}",
        f"random changes of the same size, one for each {unit}, succeed on {search}; "
        f"attacks of more {units}: {', '.join(rates)}",
        *(f"warning: {warning}" for warning in warnings(checks)),
    ]


def _both_rates(rate: float, without_noise: float, has_noise: bool) -> str:
    """Write a rate of success and, if noise counts, the rate without noise.

    Args:
        rate: Rate of success, in [0, 1].
        without_noise: Rate of success in images without noise.
        has_noise: Whether a success must remain with a sensor's noise.
    """
    if not has_noise:
        return f"{rate:.0%}"
    return f"{rate:.0%} ({without_noise:.0%} without noise)"


def _version_line(version: str, adversaries: Sequence[Mapping[str, Any]], has_noise: bool) -> str:
    """Write how often adversaries still succeed in another version of their images.

    Args:
        version: Key of VERSIONS.
        adversaries: Lines of attack.jsonl of the successful examples. "versions"
            has the results of each version.
        has_noise: Whether a success must remain with a sensor's noise.
    """
    results = [line["versions"][version] for line in adversaries]
    success = sum(result["success"] for result in results)
    without_noise = ""
    if has_noise:
        count = sum(result[f"success{WITHOUT_NOISE}"] for result in results)
        without_noise = f" ({count} without noise)"
    # Adversaries that deceived the classifier with the margin that was asked for.
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
    """Write how often adversaries succeed elsewhere.

    Args:
        transfers: Results of `nb.transfer`.
        path: File, which gets a line of JSON for each result.

    Returns:
        Table of the rates of success.
    """
    lines = []
    rows = []
    for found in transfers:
        clean = found["clean_correct"]
        rate = fraction(_count_correct(found["success"], clean), sum(clean))
        # The key of the first entry is what the adversaries are transferred to,
        # such as a classifier. Its value is the name.
        kind = next(iter(found))
        entry = {kind: found[kind], **asdict(rate), **found}
        lines.append(json.dumps(entry) + "\n")
        without_noise = _count_correct(found[f"success{WITHOUT_NOISE}"], clean)
        correct = f"{rate.n} of {len(clean)}"
        rows.append([f"{kind} {found[kind]}", correct, format_fraction(rate), str(without_noise)])
    atomic_write(path, "".join(lines))
    header = ["adversaries shown to", "correct before", "success", "without noise"]
    return str(Table("", header, rows))


def _count_correct(success: Sequence[bool], clean: Sequence[bool]) -> int:
    """Count the successes on examples that were correct before the attack.

    Args:
        success: Whether the attack succeeds on each example.
        clean: Whether each example was classified correctly before.
    """
    return sum(hit for hit, correct in zip(success, clean, strict=True) if correct)


def format_sweep(sweep: Sweep) -> str:
    """Write the success at each radius as a table.

    Args:
        sweep: Result of `nb.success_by_radius`.

    Returns:
        Table with a row for each radius.
    """
    rows = []
    for row in sweep:
        cells = [" + ".join(f"{name} {radius:g}" for name, radius in row["radii"].items())]
        for method in METHODS:
            cells.append(format_fraction(_rate(row[method])))
            cells.append(str(int(row[method + WITHOUT_NOISE].sum())))
        rows.append(cells)
    header = ["radius"]
    for title in METHODS.values():
        header += [title, "without noise"]
    return str(Table("", header, rows))


def _rate(success: Tensor) -> Proportion:
    """Compute the fraction of examples (N,) on which an attack succeeds."""
    return fraction(int(success.sum()), len(success))


def write_sweeps(sweeps: Mapping[str, Sweep], norms: Mapping[str, str], out: Path) -> None:
    """Write the success at each radius as a table, sweep.csv, and as a figure, sweep.png.

    The table has a row for each mesh (and all of several), method (also without
    noise) and radius. It has the rate of success on examples that were correct
    before, with its 95% Wilson interval. The figure shows the last mesh, or all
    of several.

    Args:
        sweeps: Result of `nb.success_by_radius` for each mesh.
        norms: Norm of the radius of each parameter.
        out: Folder that the files are written to.
    """
    methods = [method + end for end in ("", WITHOUT_NOISE) for method in METHODS]
    if len(sweeps) > 1:
        sweeps = {**sweeps, "all": _pool(sweeps, methods)}
    records = []
    for mesh, sweep in sweeps.items():
        for method in methods:
            for row in sweep:
                rate = asdict(_rate(row[method]))
                records.append({"mesh": mesh, "method": method, **row["radii"], **rate})
    text = io.StringIO()
    table = csv.DictWriter(text, list(records[0]))
    table.writeheader()
    table.writerows(records)
    atomic_write(out / TABLE, text.getvalue())
    last_mesh = records[-1]["mesh"]
    drawn = [record for record in records if record["mesh"] == last_mesh and record["n"]]
    _draw(drawn, norms, out / FIGURE)


def _pool(sweeps: Mapping[str, Sweep], methods: Sequence[str]) -> Sweep:
    """Join the examples of all meshes at each radius.

    Args:
        sweeps: Success at each radius, for each mesh. All meshes have the same
            radii.
        methods: Keys of the successes.

    Returns:
        Success at each radius on the examples of all meshes.
    """
    pooled = []
    for rows in zip(*sweeps.values(), strict=True):
        success = {method: torch.cat([row[method] for row in rows]) for method in methods}
        pooled.append({"radii": rows[0]["radii"], **success})
    return pooled


def _draw(records: Sequence[Mapping[str, Any]], norms: Mapping[str, str], path: Path) -> None:
    """Draw the rate of success of each method against the radius.

    Args:
        records: Rows of sweep.csv of one mesh.
        norms: Norm of the radius by attacked parameter. The axis shows the
            radius of the first parameter.
        path: File of the figure.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5, 3.8), layout="constrained")
    axes = figure.subplots()
    first, *others = norms
    # The adversarial line is solid, the other one dashed.
    styles = zip(COLORS, LINES[1::-1], MARKERS, strict=False)
    for (method, title), (color, line, marker) in zip(METHODS.items(), styles, strict=False):
        rows = [record for record in records if record["method"] == method]
        radii = [row[first] for row in rows]
        values = [row["value"] for row in rows]
        axes.plot(radii, values, color=color, linestyle=line, marker=marker, label=title)
        low = [row["low"] for row in rows]
        high = [row["high"] for row in rows]
        axes.fill_between(radii, low, high, color=color, alpha=0.15)
    proportional = f"; {' and '.join(others)} in proportion" if others else ""
    axes.set(xscale="log", ylim=(-0.03, 1.03), ylabel="success rate")
    axes.set_xlabel(f"{norms[first]} radius of {first}{proportional}")
    ticks = sorted({record[first] for record in records})
    axes.set_xticks(ticks, [f"{radius:g}" for radius in ticks])
    axes.set_xticks([], minor=True)
    axes.spines[["top", "right"]].set_visible(False)
    if records:
        count = records[0]["n"]
        axes.set_title(f"{count} examples correct before, 95 % intervals", fontsize=10)
        figure.legend(loc="outside lower center", ncols=2, frameon=False)
    image = io.BytesIO()
    figure.savefig(image, dpi=150)
    atomic_write(path, image.getbuffer())
