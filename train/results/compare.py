"""Comparison of finished training runs by their metrics on photographs.

A method is a way to train a network. Runs that differ only in their seed are
runs of the same method. An `Evaluation` holds the predictions of one run for one
folder of photographs. `difference` compares a metric of two methods, with a 95%
interval.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from statistics import fmean

from renderer.errors import InputError
from train.results.intervals import Jackknife, change
from train.results.metrics import COUNTED_EACH, METRICS, TOP_RANKS, Pool, Pooled, metric_title
from train.results.predictions import Prediction
from train.results.store import (
    INITIAL,
    Methods,
    RunSummary,
    Scored,
    ScoredRun,
)
from train.results.tables import Estimate, Table, describe_intervals, format_interval
from train.settings import in_words

# `class_table` has no rows if there are more classes than this.
MAX_CLASSES = 30
# Titles of the columns of tables that have a column for each metric in `METRICS`.
TITLES = [metric_title(name) for name in METRICS]


def label_title(label: str) -> str:
    """Return the title of the row of a positive class in tables, such as "label=orange"."""
    return f"label={label}"


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


def group_by_images(methods: Methods) -> dict[str, Scored]:
    """Group runs by the images on which they were scored."""
    groups: dict[str, dict[str, list[ScoredRun]]] = {}
    for method, runs in methods.items():
        for run in runs:
            for name, scores in run.photographs.items():
                group = groups.setdefault(scores.images, {})
                group.setdefault(method, []).append(ScoredRun(run, name))
    titled: dict[str, Scored] = {}
    for group in groups.values():
        title = _title_of(group)
        if title in titled:
            title = f"{title} ({len(titled) + 1})"
        titled[title] = group
    return titled


def _title_of(group: Scored) -> str:
    """Write a title for the images on which a group of networks was scored."""
    members = [scored for scored_runs in group.values() for scored in scored_runs]
    # The name of the sub-folder comes from a training run if there is one, because the user
    # has chosen this name. Only a training run has epochs.
    of_training = [scored for scored in members if scored.run.epochs]
    first = of_training[0] if of_training else members[0]
    auc = first.scores.overall.auc
    if not auc.positives + auc.negatives:
        return first.name
    labels = first.scores.labels
    title = (
        f"{first.name}: {auc.positives:,} images of {' or '.join(labels)}, "
        f"{auc.negatives:,} images of other objects"
    )
    if len(labels) > 1:
        title += COUNTED_EACH
    return f"{title}; {describe_intervals([auc])}" if auc.low is not None else title


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


def require_meshes(methods: Evaluations, by: str) -> None:
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
