"""Tables that compare finished training runs by their metrics on photographs.

A method is a way to train a network. Runs that differ only in their seed are
runs of the same method. An `Evaluation` holds the predictions of one run for one
folder of photographs. `difference` compares a metric of two methods, with a 95%
interval.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import fmean

from augment.augmentation_settings import MODES
from renderer.errors import InputError
from train.results.intervals import Jackknife, change
from train.results.metrics import METRICS, TOP_RANKS, Pool, Pooled, metric_title
from train.results.predictions import CONTACT_SHEET, Prediction
from train.results.store import (
    INITIAL,
    RunSummary,
    Scored,
    ScoredRun,
    accuracy_title,
    group_by_images,
    group_by_method,
    label_title,
    run_tables,
    seconds_table,
)
from train.results.tables import Estimate, Table, describe_intervals, format_interval
from train.settings import PHOTOGRAPHS, in_words

# `class_table` has no rows if there are more classes than this.
MAX_CLASSES = 30
# Titles of the columns of tables that have a column for each metric in `METRICS`.
TITLES = [metric_title(name) for name in METRICS]
# Metrics in the table that commands print without --verbose.
SHORT_METRICS = ("recall", "false_positive_rate", "auc", "class_top1")


@dataclass(frozen=True)
class Subset:
    """Subset of the images of an evaluation, such as the images of one source.

    Tables have a row for each subset.

    Attributes:
        by: Property that the images of the subset have in common: "label",
            "source", "mesh" or "class". "all" for the set of all images.
        name: Value of the property, such as the name of the source. Empty for
            the set of all images.
    """

    by: str = "all"
    name: str = ""

    def title(self, overall: str = "all") -> str:
        """Return the title of the row of this subset in a table."""
        if self == ALL:
            return overall
        if self.by == "label":
            return label_title(self.name)
        return self.name

    @property
    def is_overall(self) -> bool:
        """Whether the subset has images of all sources, for all labels or for one label."""
        return self.by in ("all", "label")


# All images, except those of sources that the user excludes.
ALL = Subset()


@dataclass(frozen=True)
class Evaluation:
    """Predictions of the network of a run for one folder of photographs.

    Attributes:
        run: Run that trained the network.
        pooled: The predictions, which are scored together and in groups.
    """

    run: RunSummary
    pooled: Pooled

    def pools(self, *properties: str) -> dict[Subset, Pool]:
        """Predictions for all images, and for the subsets by some properties."""
        pools = {ALL: self.pooled.all}
        for by in properties:
            pools |= {Subset(by, name): pool for name, pool in self.pooled.groups(by).items()}
        return pools

    def rows(self, by: str) -> dict[Subset, Pool]:
        """Predictions for each row of a table: all, several positive classes, and subsets."""
        has_several_labels = len(self.pooled.by_label) > 1
        return self.pools("label", by) if has_several_labels else self.pools(by)

    def find(self, subset: Subset) -> Pool | None:
        """Predictions for a subset. None if there are none."""
        return self.pooled.groups(subset.by).get(subset.name)


# Evaluations of the runs of each method, in the order of their seeds.
Evaluations = Mapping[str, Sequence[Evaluation]]


def read_evaluations(group: Scored, exclude: Sequence[str] = ()) -> Evaluations:
    """Read the predictions of runs that were scored on the same images.

    A published network has no file of predictions, and is left out. Sources in `exclude` do not
    count among all images.
    """
    methods: dict[str, list[Evaluation]] = {}
    for method, scored_runs in group.items():
        for scored in sorted(scored_runs, key=lambda item: item.run.seed or 0):
            if scored.has_predictions:
                pooled = scored.pooled(exclude)
                _require_sources(exclude, pooled.predictions)
                methods.setdefault(method, []).append(Evaluation(scored.run, pooled))
    return methods


def _require_sources(names: Sequence[str], predictions: Sequence[Prediction]) -> None:
    """Check that each source that a user excludes is the source of some photograph."""
    sources = {item.photograph.source for item in predictions}
    unknown = set(names) - sources
    if unknown:
        known = ", ".join(sorted(filter(None, sources)))
        raise InputError(
            f"exclude: no photograph is of source {min(unknown)!r}: choose among {known}",
        )


def _require_meshes(methods: Evaluations, by: str) -> None:
    """Check that the photographs have meshes if scores by mesh are asked for."""
    for method, evaluations in methods.items():
        if by == "mesh" and not all(evaluation.pooled.by_mesh for evaluation in evaluations):
            raise InputError(
                f"by=mesh needs the mesh of each photograph, but the photographs of {method} have "
                "none: leave by=mesh out"
            )


def mean_metric(evaluations: Sequence[Evaluation], subset: Subset, name: str) -> Estimate | None:
    """Average a metric over the seeds of a method.

    The interval is that of the only seed, or goes from the lowest to the highest of several. None
    if no seed has the metric.
    """
    known: list[Estimate] = []
    values: list[float] = []
    for evaluation in evaluations:
        pool = evaluation.find(subset)
        metric = pool.metrics.find(name) if pool is not None else None
        if metric is not None and metric.value is not None:
            known.append(metric)
            values.append(metric.value)
    if not known:
        return None
    if len(known) == 1:
        return known[0]
    over = f"lowest and highest of {len(values)} seeds"
    return Estimate(value=fmean(values), low=min(values), high=max(values), over=over)


def group_table(methods: Evaluations, overall: str = "all", by: str = "source") -> Table:
    """Make a table of the metrics, means over seeds, of each method on each subset of images."""
    # A dictionary has each subset once, in order.
    subsets: dict[Subset, None] = {}
    for evaluations in methods.values():
        for evaluation in evaluations:
            subsets.update(dict.fromkeys(evaluation.rows(by)))
    rows: list[list[str]] = []
    shown: list[Estimate | None] = []
    for subset in subsets:
        for method, evaluations in methods.items():
            metrics = [mean_metric(evaluations, subset, name) for name in METRICS]
            shown += metrics
            rows.append([subset.title(overall), method, *map(format_interval, metrics)])
    return Table(f"by {by}, {describe_intervals(shown)}", [by, "network", *TITLES], rows)


def choose_pairs(methods: Evaluations) -> list[tuple[str, str]]:
    """Choose which methods are compared.

    Each method is compared with its initial network, the network with whose weights its runs began.
    It is also compared with the first method. A pair is a method and its reference.
    """
    first_runs = {method: evaluations[0].run for method, evaluations in methods.items()}
    pairs = []
    for method, run in first_runs.items():
        initial_network = run.before
        if initial_network is None:
            continue
        for reference, reference_run in first_runs.items():
            # The initial network is the method whose settings name the same network.
            if reference_run.settings == initial_network.settings:
                pairs.append((method, reference))
    trained = [method for method, run in first_runs.items() if run.method != INITIAL]
    return pairs + [(method, trained[0]) for method in trained[1:]]


def class_table(methods: Evaluations) -> Table:
    """Make a table of the top-1 and top-5 accuracy for the images of each class.

    The accuracies are among all classes of the network. The table has no rows if the networks have
    one such class, or more than MAX_CLASSES.
    """
    header = ["class", "images", "network", "top-1", "top-5"]
    rows: list[list[str]] = []
    image_counts: dict[str, int] = {}
    for evaluations in methods.values():
        for name, pool in evaluations[0].pooled.by_class.items():
            if pool.classified:
                image_counts[name] = len(pool.classified)
    if 1 < len(image_counts) <= MAX_CLASSES:
        for name, image_count in image_counts.items():
            for method, evaluations in methods.items():
                subset = Subset("class", name)
                metrics = (mean_metric(evaluations, subset, metric) for metric in TOP_RANKS)
                cells = map(format_interval, metrics)
                rows.append([in_words(name), str(image_count), method, *cells])
    return Table("by class, among all classes of the network", header, rows)


@dataclass(frozen=True)
class Difference(Estimate):
    """Difference of a metric between a method and a reference, with its 95% interval.

    Attributes:
        before: Mean of the metric over the seeds of the reference.
        after: Mean of the metric over the seeds of the method.
    """

    before: float = 0.0
    after: float = 0.0


def difference(
    evaluations: Sequence[Evaluation],
    reference: Sequence[Evaluation],
    subset: Subset,
    name: str,
) -> Difference | None:
    """Compare a metric of a method with that of a reference: mean minus mean over the seeds.

    The 95% interval is paired: both methods are measured without the same objects. With several
    seeds, it is also over seeds. With one seed, it says nothing about other seeds. The value is
    `evaluations` minus `reference`. None if the metric of a run is unknown.
    """
    after = _jackknives(evaluations, subset, name)
    before = _jackknives(reference, subset, name)
    if len(after) < len(evaluations) or len(before) < len(reference):
        return None
    return Difference(
        **asdict(change(after, before, _have_equal_seeds(evaluations, reference))),
        before=fmean(run.value for run in before),
        after=fmean(run.value for run in after),
    )


def _jackknives(evaluations: Sequence[Evaluation], subset: Subset, name: str) -> list[Jackknife]:
    """Collect the values of a metric without each unit, from the runs in which it is known."""
    pools = [evaluation.find(subset) for evaluation in evaluations]
    return [pool.jackknives[name] for pool in pools if pool and name in pool.jackknives]


def _have_equal_seeds(evaluations: Sequence[Evaluation], reference: Sequence[Evaluation]) -> bool:
    """Return whether the runs of two methods have the same seeds, in the same order."""
    seeds = [evaluation.run.seed or 0 for evaluation in evaluations]
    reference_seeds = [evaluation.run.seed or 0 for evaluation in reference]
    return seeds == reference_seeds


def difference_tables(
    methods: Evaluations,
    overall: str = "all",
    by: str = "source",
    overall_only: bool = False,
) -> list[Table]:
    """Make a table of the differences of the metrics for each pair of methods."""
    tables = []
    for method, base in choose_pairs(methods):
        evaluations = methods[method]
        reference = methods[base]
        rows = []
        shown: list[Difference | None] = []
        for subset in reference[0].rows(by):
            if overall_only and not subset.is_overall:
                continue
            differences = [difference(evaluations, reference, subset, name) for name in METRICS]
            shown += differences
            cells = [format_interval(item, sign="+") for item in differences]
            rows.append([subset.title(overall), *cells])
        paired = ", paired" if _have_equal_seeds(evaluations, reference) else ""
        counts = f"{len(evaluations)} and {len(reference)} seeds{paired}"
        title = f"{method} minus {base} ({counts}), {describe_intervals(shown)}"
        tables.append(Table(title, [by, *TITLES], rows))
    return tables


def overall_differences(methods: Evaluations) -> Table:
    """Make one table of the differences between methods on the images of all sources."""
    rows = []
    for table in difference_tables(methods, overall="", overall_only=True):
        for name, *cells in table.rows:
            title = f"{table.title}, {name}" if name else table.title
            rows.append([title, *cells])
    return Table("differences on the same images", ["networks", *TITLES], rows)


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
        _require_meshes(evaluations, by)
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
    _require_meshes(evaluations, by)
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
