"""Tables of runs: their accuracy, scores, settings and seconds, and what commands print of them."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import fmean, stdev

from augment.augmentation_settings import MODES
from renderer.errors import InputError
from train.results.compare import (
    ALL,
    Evaluations,
    difference,
    difference_tables,
    group_by_images,
    group_table,
    label_title,
    mean_metric,
    overall_differences,
    read_evaluations,
    require_meshes,
)
from train.results.metrics import METRICS, metric_title
from train.results.predictions import CONTACT_SHEET
from train.results.store import (
    Methods,
    RunSummary,
    Scored,
    ScoredRun,
    group_by_method,
    varied_settings,
)
from train.results.tables import Estimate, Table, format_interval
from train.run_folder import PHASES
from train.settings import PHOTOGRAPHS, UNLABELED

# Metrics in the table that commands print without --verbose.
SHORT_METRICS = ("recall", "false_positive_rate", "auc", "class_top1")


def run_tables(methods: Methods, groups: Mapping[str, Scored]) -> list[Table]:
    """Make tables of the accuracy, the scores and the settings of runs."""
    tables = [_accuracy_table(methods)]
    tables += [score_table(title, group) for title, group in groups.items()]
    settings = _settings_table(methods)
    if settings.rows:
        tables.append(settings)
    return tables


def _settings_table(methods: Methods) -> Table:
    """Make a table of the settings in which methods differ."""
    # The first run of each method. Networks without a run have no settings of a training.
    heads = {method: runs[0] for method, runs in methods.items() if runs[0].seed is not None}
    varied = varied_settings([*heads.values()])
    rows = []
    if varied:
        for method, head in heads.items():
            rows.append([method, *(str(head.settings.get(key)) for key in varied)])
    return Table("settings in which the methods differ", ["network", *varied.values()], rows)


def _accuracy_table(methods: Methods) -> Table:
    """Make a table of the accuracy of each run on the test images."""
    lines: dict[str, list[Line]] = {}
    test_images = []
    for method, runs in methods.items():
        for run in runs:
            test_images.append(run.config.get("test_images", ""))
            if runs[0].accuracy is not None:
                last = run.scores.get("test/accuracy_last")
                line = (run.seed, [Estimate(run.accuracy), Estimate(last)])
                lines.setdefault(method, []).append(line)
    # A dictionary has each name once, in the order of the runs.
    names = dict.fromkeys(name for name in test_images if name)
    title = " or ".join(f"accuracy on {name}" for name in names)
    every_run = [run for runs in methods.values() for run in runs]
    return _run_table(title, [accuracy_title(every_run), "of the last epoch"], lines)


def accuracy_title(runs: Sequence[RunSummary]) -> str:
    """Return the title of the column with the accuracy of runs on their test images.

    Images without labels are labeled with the predictions of the network before the training.
    """
    names = {run.config.get("data", {}).get("name") for run in runs if run.config}
    return "agreement with the original" if names == {UNLABELED} else "test accuracy"


def score_table(title: str, group: Scored) -> Table:
    """Make a table of the metrics of runs on the same images."""
    lines: dict[str, list[Line]] = {}
    for method, scored_runs in group.items():
        for scored in scored_runs:
            metrics_of_row = {method: scored.scores.overall}
            for label, metrics in scored.scores.by_label.items():
                metrics_of_row[f"{method}, {label_title(label)}"] = metrics
            for name, metrics in metrics_of_row.items():
                line = (scored.run.seed, [*map(metrics.find, METRICS)])
                lines.setdefault(name, []).append(line)
    points = {scored.scores.operating_point for runs in group.values() for scored in runs}
    chosen = " or ".join(sorted(points - {""}))
    if chosen:
        title += f"; threshold for {chosen}"
    return _run_table(title, [metric_title(name) for name in METRICS], lines)


def seconds_table(methods: Methods) -> Table:
    """Make a table of the seconds that an epoch of the first run of each method takes, by phase."""
    titles = {phase: phase.replace("_", " and ") for phase in PHASES}
    titles["attack_classifier"] = "attack: in the classifier"
    titles["operators"] = "operators, once"
    rows = []
    for method, (run, *_) in methods.items():
        means = {phase: _mean_seconds(run, phase) for phase in titles}
        if all(mean is None for mean in means.values()):
            continue
        total = sum(means[phase] or 0 for phase in PHASES)
        rows.append([method, *(f"{mean or 0:.2f}" for mean in (total, *means.values()))])
    return Table("seconds per epoch", ["network", "all", *titles.values()], rows)


def _mean_seconds(run: RunSummary, phase: str) -> float | None:
    """Average the seconds that a phase of an epoch takes over the epochs of a run.

    None if no epoch records the phase.
    """
    name = f"seconds/{phase}"
    seconds = [line[name] for line in run.epochs if name in line]
    return fmean(seconds) if seconds else None


# A row of a table: the seed of a run, and the metric of each column.
Line = tuple[int | None, Sequence[Estimate | None]]


def _run_table(title: str, header: Sequence[str], lines: Mapping[str, Sequence[Line]]) -> Table:
    """Make a table with a row for each run.

    A line is a seed and the metrics in the order of `header`. Several seeds get a row of their mean
    ± standard deviation.
    """
    rows = []
    for method, runs in lines.items():
        for seed, metrics in runs:
            cells = map(format_interval, metrics)
            rows.append([method, "" if seed is None else str(seed), *cells])
        if len({seed for seed, _ in runs}) > 1:
            # A column has the values of one metric in all runs of the method.
            columns = zip(*(metrics for _, metrics in runs), strict=True)
            rows.append([method, f"{len(runs)} seeds", *map(_format_spread, columns)])
    return Table(title, ["network", "seed", *header], rows)


def _format_spread(metrics: Sequence[Estimate | None]) -> str:
    """Write the mean and standard deviation over runs: "0.912 ± 0.004", or "-" if unknown."""
    values = [metric.value for metric in metrics if metric is not None and metric.value is not None]
    if len(values) < len(metrics):
        return "-"
    return f"{fmean(values):.3f} ± {stdev(values):.3f}"


def format_table(runs: Sequence[RunSummary]) -> str:
    """Compare runs in the tables that pnb-train --verbose prints after training."""
    methods = group_by_method(runs)
    groups = group_by_images(methods)
    tables = run_tables(methods, groups)
    for group in groups.values():
        tables.append(overall_differences(read_evaluations(group)))

    used_modes = {run.method for run in runs}
    captions = [f"{mode}: {caption}" for mode, caption in MODES.items() if mode in used_modes]
    sheets = []
    for run in runs:
        sheets += [f"image: {run.folder / name / CONTACT_SHEET}" for name in run.photographs]
    parts = [_format_tables(tables), "; ".join(captions), "\n".join(sheets)]
    return "\n\n".join(part for part in parts if part)


def _format_tables(tables: Sequence[Table]) -> str:
    """Write tables as Markdown, with an empty line between them.

    A table without rows, and a column without known values, are left out.
    """
    return "\n\n".join(str(table.without_unknown_columns) for table in tables if table.rows)


def format_comparison(
    runs: Sequence[RunSummary],
    exclude: Sequence[str],
    photographs: str = PHOTOGRAPHS,
    by: str = "source",
) -> str:
    """Compare runs in the tables that pnb-compare prints."""
    methods = group_by_method(runs)
    groups = group_by_images(methods)
    tables = run_tables(methods, groups)
    overall = _title_of_all(exclude)
    group = _find_group(list(groups.values()), photographs)
    if group is not None:
        evaluations = read_evaluations(group, exclude)
        require_meshes(evaluations, by)
        tables.append(group_table(evaluations, overall, by))
        tables += difference_tables(evaluations, overall, by)
    tables.append(seconds_table(methods))
    return _format_tables(tables)


def format_short_comparison(
    runs: Sequence[RunSummary],
    exclude: Sequence[str] = (),
    photographs: str = PHOTOGRAPHS,
    by: str = "source",
) -> str:
    """Compare runs in one table, which pnb-train and pnb-compare print without --verbose.

    Without the usual sub-folder "photographs", the first photographs of the runs are compared. The
    gain in AUC is over the first method.
    """
    methods = group_by_method(runs)
    groups = group_by_images(methods)
    group = _find_group(list(groups.values()), photographs)
    if group is None and groups:
        # The first images on which runs were scored.
        group = next(iter(groups.values()))
    evaluations = read_evaluations(group, exclude) if group else {}
    require_meshes(evaluations, by)
    if by != "source" and evaluations:
        return str(group_table(evaluations, _title_of_all(exclude), by).without_unknown_columns)
    titles = [title for title, members in groups.items() if members is group]
    rows = []
    for method, runs_of_method in methods.items():
        if method not in evaluations and not exclude:
            # A published network has stored metrics, but no predictions.
            scored_runs = group.get(method, ()) if group else ()
            metrics = [_mean_stored_metric(scored_runs, name) for name in SHORT_METRICS]
        else:
            of_method = evaluations.get(method, ())
            metrics = [mean_metric(of_method, ALL, name) for name in SHORT_METRICS]
        values = [_format_value(metric) for metric in (_mean_accuracy(runs_of_method), *metrics)]
        gain = _format_gain(evaluations, method)
        rows.append([method, len(runs_of_method), *values, gain])
    every_run = [run for runs_of_method in methods.values() for run in runs_of_method]
    header = ["network", "runs", accuracy_title(every_run), *map(metric_title, SHORT_METRICS)]
    return str(Table("".join(titles), [*header, "gain in AUC [95%]"], rows).without_unknown_columns)


def _mean_accuracy(runs: Sequence[RunSummary]) -> Estimate | None:
    """Average the accuracy on the test images over runs."""
    accuracies = [run.accuracy for run in runs if run.accuracy is not None]
    return Estimate(fmean(accuracies)) if accuracies else None


def _title_of_all(exclude: Sequence[str]) -> str:
    """Return the title of the row of all images: "all", or "all but A, B" without these sources."""
    return f"all but {', '.join(exclude)}" if exclude else "all"


def _mean_stored_metric(scored_runs: Sequence[ScoredRun], name: str) -> Estimate | None:
    """Average a metric over the stored scores of runs, which lack the file predictions.csv."""
    values = []
    for scored in scored_runs:
        metric = scored.scores.overall.find(name)
        if metric is not None and metric.value is not None:
            values.append(metric.value)
    return Estimate(fmean(values)) if values else None


def _format_value(metric: Estimate | None) -> str:
    """Write the value of a metric without its interval, or "-" if it is unknown."""
    return format_interval(None if metric is None else Estimate(metric.value))


def _format_gain(methods: Evaluations, method: str) -> str:
    """Write the gain in AUC: the AUC of a method minus the AUC of the first method.

    It is "-" for the first method itself, and for a method without evaluations.
    """
    first = next(iter(methods), method)
    if method == first or method not in methods:
        return "-"
    gain = difference(methods[method], methods[first], ALL, "auc")
    return format_interval(gain, sign="+")


def _find_group(groups: Sequence[Scored], photographs: str) -> Scored | None:
    """Find the runs whose scores lie in a sub-folder of a given name.

    None if no run has the usual sub-folder "photographs"; any other name that no run has is an
    error.
    """
    found = [group for group in groups if _is_scored_on(group, photographs)]
    if len(found) > 1:
        first = _first_folder(found[0])
        second = _first_folder(found[1])
        raise InputError(
            f"{second} has other photographs or sources than {first}: "
            "score both networks on the same folder with pnb-evaluate",
        )
    if not found and photographs != PHOTOGRAPHS:
        raise InputError(
            f"photos={photographs}: no run has a sub-folder of this name with scores: "
            "give a name in the setting photos of the runs",
        )
    return found[0] if found else None


def _first_folder(group: Scored) -> Path:
    """Return the folder of the scores of the first run in a group."""
    first_runs = next(iter(group.values()))
    return first_runs[0].folder


def _is_scored_on(group: Scored, photographs: str) -> bool:
    """Return whether the scores of a group of networks may be those of a given sub-folder.

    A run has its scores in a sub-folder, whose name the user chooses. A network
    that is not a run, such as a published network, has no seed and no such
    sub-folder. Its scores may be compared with those in any sub-folder.
    """
    for scored_runs in group.values():
        for scored in scored_runs:
            is_run = scored.run.seed is not None
            if scored.name == photographs or not is_run:
                return True
    return False
