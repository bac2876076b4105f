"""The page report.html, which shows runs and attacks. It loads no other file."""

import base64
import hashlib
import shlex
import traceback
from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import datetime
from itertools import islice
from pathlib import Path
from statistics import fmean
from typing import Any

from omegaconf import OmegaConf

from augment.progress import progress_message
from augment.settings import MODES
from renderer.errors import InputError
from renderer.io.files import atomic_write
from train.evaluation.laboratory.kept_aside import can_be_generated
from train.evaluation.scores.scoring import CONTACT_SHEET
from train.evaluation.scores.sheet import evenly_spaced
from train.evaluation.tables import (
    Table,
    as_text,
    format_fraction,
    format_interval,
    fraction,
    join_words,
)
from train.report import comparison as compare
from train.report import plots, summary
from train.report.first_screen import (
    NETWORKS,
    Compared,
    FirstScreen,
    compare_networks,
    contrasts,
    in_words,
    place_of,
)
from train.report.plots import Picture
from train.report.summary import Methods, RunSummary, Scored, ScoredRun
from train.runs.epoch_metrics import attack_success
from train.runs.run_config import CONFIG, read_config
from train.runs.run_log import RENDERS
from train.settings import KEPT_ASIDE, LABORATORY, PHOTOGRAPHS, published
from train.system.user_errors import user_message

# Name of the file.
PAGE = "report.html"
# Largest number of methods in plots and comparisons.
MAX_METHODS = 6
# Largest number of seeds of a method in plots and comparisons.
MAX_SEEDS = 5
# Largest number of unfinished runs in plots.
MAX_UNFINISHED = 3
# Largest number of attacks of which the page shows images.
MAX_ATTACKS = 12
# Largest number of examples of an attack of which the page shows images.
ATTACK_EXAMPLES = 4
# Number of epochs of which the renders are shown.
SHOWN_EPOCHS = 3
# Characters at the end of the name of a folder that the legend of a plot shows.
FOLDER_NAME_LENGTH = 24
# Largest width of an image with a grid of renders, in pixels.
GRID_WIDTH = 720
# Largest width of a contact sheet and of an image of an attack, in pixels.
SHEET_WIDTH = 1100
# Titles of the plots of metrics by epoch.
CURVES = {"train/accuracy": "training accuracy", "validation/accuracy": "validation accuracy"}


@progress_message("report")
def write_report(folders: Sequence[Path], out: Path) -> Path:
    """Write the page of the runs and attacks in folders and below them.

    Args:
        folders: Folders of runs and attacks, or folders that hold them.
        out: Folder that report.html is written to.

    Returns:
        Path of the page. A run or attack that cannot be read is named on it.

    Raises:
        InputError: If a folder is missing or none holds a run or an attack.
    """
    found = summary.find(folders)
    methods = summary.group_by_method(found.runs)
    drawn = {name: runs[:MAX_SEEDS] for name, runs in islice(methods.items(), MAX_METHODS)}
    renders = {}
    examples = {}
    for method, runs in drawn.items():
        first = runs[0]
        if first.epochs:
            renders[method] = _pictures(first, "epoch", "Renders")
            examples[method] = _pictures(first, "attacks", "Renders before and after")
    groups = summary.group_by_images(drawn)
    return write_page(
        out,
        "runs.html.jinja",
        about=_about(found, folders),
        methods=methods,
        title=_title(found, methods),
        screen=_first_screen(groups),
        lead=[*_accuracy_sentences(methods), *_relit_sentences(methods)],
        tables=[table for table in summary.run_tables(methods, {}) if table.rows],
        captions=MODES,
        unfinished=[[str(run.folder), run.state, len(run.epochs)] for run in found.unfinished],
        curves=_curves(_drawn_epochs(drawn, found.unfinished)),
        seconds=summary.seconds_table(drawn),
        photographs=[scores_section(title, group) for title, group in groups.items()],
        renders=renders,
        examples=examples,
        attacks=found.attacks,
        shown=[_attack(attack) for attack in found.attacks[:MAX_ATTACKS]],
    )


def _about(found: summary.Findings, folders: Sequence[Path]) -> str:
    """Write the line below the title of the page.

    Args:
        found: Runs and attacks on the page.
        folders: Folders that the user named.

    Returns:
        Text with the numbers of networks, unfinished runs and attacks, with the
        folders, and with the time at which the newest file was written.
    """
    counts = []
    if found.runs:
        plural = "s" if len(found.runs) != 1 else ""
        counts.append(f"{len(found.runs)} network{plural}")
    if found.unfinished:
        counts.append(f"{len(found.unfinished)} unfinished or unreadable")
    if found.attacks:
        counts.append(f"{len(found.attacks)} attacks")
    about = f"{', '.join(counts)}; in {', '.join(map(str, folders))}"

    shown_folders = [run.folder for run in found.runs]
    shown_folders += [attack.folder for attack in found.attacks]
    times = []
    for folder in shown_folders:
        times += [file.stat().st_mtime for file in folder.iterdir() if file.name != PAGE]
    if times:
        about += f", {datetime.fromtimestamp(max(times)):%Y-%m-%d %H:%M}"
    return about


def _title(found: summary.Findings, methods: Methods) -> str:
    """Write the title of the page.

    Args:
        found: Runs and attacks on the page.
        methods: Runs of each method. Initial networks count as methods.

    Returns:
        Text with the positive classes. If no method is an initial network, the
        methods follow. Without any method, the title is "Attacks" or
        "Unfinished runs".
    """
    if not methods:
        return "Attacks" if found.attacks else "Unfinished runs"
    labels: set[str] = set()
    for runs in methods.values():
        for scores in runs[0].photographs.values():
            labels.update(scores.labels)
    trained = [method for method, runs in methods.items() if runs[0].method != summary.INITIAL]
    if labels and len(trained) < len(methods):
        return f"Hardened against unusual lighting: {', '.join(map(in_words, sorted(labels)))}"
    subject = " and ".join(sorted(labels)) or "Networks"
    return f"{subject}, trained with renders: {', '.join(trained)}"


# For each method, a list of its runs. A run is a list of its epochs, and an epoch
# is a mapping of metrics by name, from one line of metrics.jsonl.
Epochs = Mapping[str, Sequence[Sequence[Mapping[str, float]]]]


def _drawn_epochs(drawn: Methods, unfinished: Sequence[summary.Unfinished]) -> Epochs:
    """Collect the epochs that the plots of metrics show.

    Args:
        drawn: Finished runs of each method in plots.
        unfinished: Runs that are not finished.

    Returns:
        Epochs of the runs of each method. Each of the first MAX_UNFINISHED
        unfinished runs with epochs is a method of its own, such as
        "unfinished: FOLDER".
    """
    epochs = {method: [run.epochs for run in runs] for method, runs in drawn.items()}
    started = [run for run in unfinished if run.epochs]
    for run in started[:MAX_UNFINISHED]:
        name = run.folder.name[-FOLDER_NAME_LENGTH:]
        epochs[f"unfinished: {name}"] = [run.epochs]
    return epochs


def write_page(out: Path, body: str, script: str = "", **content: Any) -> Path:
    """Render a template inside the frame that all pages share, and write it to report.html.

    Args:
        out: Folder of the page. If it does not exist, it is made.
        body: File name of the template with the sections of the page.
        script: JavaScript of the page, the only one that a browser runs in it.
        **content: Values of the template. All pages need `title`, and `about`,
            the line below the title.

    Returns:
        Path of the page.
    """
    # Training imports this module, and needs jinja2 only at its end.
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("train.report", "."),
        undefined=StrictUndefined,
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["as_text"] = as_text
    environment.filters["command"] = _command
    environment.filters["fraction"] = fraction
    environment.filters["hits"] = format_fraction
    environment.filters["interval"] = format_interval
    environment.filters["sha256"] = _sha256
    environment.filters["yaml"] = OmegaConf.to_yaml
    page = environment.get_template("page.html.jinja").render(body=body, script=script, **content)
    out.mkdir(parents=True, exist_ok=True)
    path = out / PAGE
    atomic_write(path, page)
    return path


def _sha256(script: str) -> str:
    """Return the hash by which the content security policy of a page allows its script."""
    return base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()


def report_of(folders: Sequence[Path], out: Path) -> str:
    """Write the page of finished runs, and describe it for the console.

    If the page cannot be written, the text says why. No error is raised, since
    the runs are finished and saved, and their command must not fail.

    Args:
        folders: Folders of the runs.
        out: Folder that report.html is written to.

    Returns:
        Text for the console: the path of the page, below one paragraph that
        says what hardening changed. The paragraph is absent if the runs have no
        scores before and after hardening.
    """
    try:
        lines = [f"report: {write_report(folders, out)}"]
        groups = summary.group_by_images(summary.group_by_method(summary.find(folders).runs))
        screen = _first_screen(groups)
        if screen is not None:
            lines = [" ".join([screen.answer, *screen.sentences]), *lines]
        return "\n".join(lines)
    except Exception as error:
        return f"no report: {user_message(error) or traceback.format_exc()}"


def _command(config: Mapping[str, Any]) -> str:
    """Return the command line that started a run or an attack.

    Args:
        config: Configuration in config.yaml of the run or the attack.

    Returns:
        Lines for a shell: `cd` to the folder in which the command was started,
        and the command. Empty if the configuration records no command.
    """
    folder = config.get("working_folder")
    # Earlier versions did not record the command.
    command = config.get("command") or ""
    if folder and command:
        return f"cd {shlex.quote(folder)}\n{command}"
    return command


def _curves(methods: Epochs) -> list[Picture]:
    """Plot the metrics in `CURVES` by epoch, and the success of attacks by round of renders.

    Args:
        methods: Epochs of the runs of each method.

    Returns:
        The plots. A plot in which no value changes is left out.
    """
    pictures = []
    for name, title in CURVES.items():
        # For each method, a line for each run. Its points are (epoch, metric).
        lines: dict[str, list[plots.Points]] = {}
        for method, runs in methods.items():
            lines[method] = []
            for run in runs:
                lines[method].append([(epoch["epoch"], epoch.get(name)) for epoch in run])
        pictures.append(plots.curves(lines, title))
    rates = {}
    for method, runs in methods.items():
        rates[method] = [list(enumerate(_attack_success_by_round(run), 1)) for run in runs]
    title = "attack success on clean-correct renders"
    pictures.append(plots.curves(rates, title, "round of renders"))
    return [picture for picture in pictures if picture is not None]


def _attack_success_by_round(epochs: Sequence[Mapping[str, float]]) -> list[float | None]:
    """List the success of attacks in each round of renders of a run.

    If an epoch has several rounds, the names of its metrics begin with the
    number of the round, as in "round_3/attack_success". If it has one round,
    they begin with "augment/".

    Args:
        epochs: Metrics of each epoch by name.

    Returns:
        For each round of all epochs in turn, the fraction of renders that the
        attack makes misclassified, among those that were classified correctly
        before. None if no render was.
    """
    rates = []
    for epoch in epochs:
        rounds = {name.partition("/")[0] for name in epoch if name.startswith("round_")}
        # By number, "round_10" follows "round_9".
        ordered = sorted(rounds, key=lambda name: int(name.removeprefix("round_")))
        for prefix in ordered or ["augment"]:
            rates.append(attack_success(epoch, f"{prefix}/"))
    return rates


def _pictures(run: RunSummary, kind: str, title: str) -> list[Picture]:
    """Read the images of renders of the first, the middle and the last epoch of a run.

    Args:
        run: Finished run.
        kind: Start of the names of the files, which are renders/KIND_EPOCH.png
            in the folder of the run.
        title: What the images show, for readers who do not see them.

    Returns:
        An image for each of at most SHOWN_EPOCHS epochs that have this file.
    """
    path_of_epoch = {}
    for path in (run.folder / RENDERS).glob(f"{kind}_*.png"):
        number = path.stem.removeprefix(f"{kind}_")
        if number.isdigit():
            path_of_epoch[int(number)] = path
    pictures = []
    for epoch in evenly_spaced(sorted(path_of_epoch), SHOWN_EPOCHS):
        alt = f"{title}, epoch {epoch}, {run.method}"
        pictures += plots.from_file(path_of_epoch[epoch], alt, GRID_WIDTH, f"epoch {epoch}")
    return pictures


def _accuracy_sentences(methods: Methods) -> list[str]:
    """Compare each method with its initial network on the test images, in sentences.

    Args:
        methods: Runs of each method.

    Returns:
        For each method, a sentence with the agreement of both networks if it
        was measured. Otherwise a sentence with both accuracies. A method that
        began with random weights has no sentence.
    """
    sentences = []
    for method, runs in methods.items():
        agreements = [run.scores.get("test/agreement") for run in runs]
        agreements_known = [agreement for agreement in agreements if agreement is not None]
        if agreements_known:
            agreement = fmean(agreements_known)
            sentences.append(
                f"{method}: on photographs that training did not use, the network predicts the "
                f"same class as the original in {agreement:.1%} of the cases."
            )
            continue
        initial = [run.before.accuracy for run in runs if run.before]
        known = [accuracy for accuracy in initial if accuracy is not None]
        if not known:
            continue
        before = fmean(known)
        after = fmean(run.scores["test/accuracy"] for run in runs)
        images = runs[0].config.get("test_images", "the test images")
        change = f"accuracy went from {before:.1%} to {after:.1%}"
        sentences.append(f"{method}: {change} on {images}.")
    return sentences


def _relit_sentences(methods: Methods) -> list[str]:
    """Say what each training on relit photographs did.

    Args:
        methods: Runs of each method.

    Returns:
        A sentence for each method that was trained with `experiment=photographs`.
    """
    sentences = []
    for method, runs in methods.items():
        scores = [run.scores for run in runs if "test/relit_agreement_after" in run.scores]
        if not scores:
            continue
        before = fmean(item["test/relit_agreement_before"] for item in scores)
        after = fmean(item["test/relit_agreement_after"] for item in scores)
        sentences.append(
            f"{method}: trained on photographs in the light of a projector. In this light, "
            f"{after:.1%} of the predictions are those for the unchanged photographs, "
            f"and {before:.1%} before."
        )
    return sentences


def _first_screen(groups: Mapping[str, Scored]) -> FirstScreen | None:
    """Compare two networks on the first images on which both were scored.

    Args:
        groups: Scored runs of each method, by a title of the images.

    Returns:
        The first screen. None if no images were scored by two networks that can
        be compared.
    """
    screens = []
    for group in groups.values():
        with suppress(InputError):
            screens.append(_compare_on(group))
    known = [screen for screen in screens if screen is not None]
    return known[0] if known else None


def _compare_on(group: Scored) -> FirstScreen | None:
    """Compare a method with its reference on the images that both were scored on.

    Args:
        group: Scored runs of each method on the same images.

    Returns:
        The first screen. It compares the last method that has an initial
        network with this network. If no method has one, it compares the last
        method with the first. None with a single method.
    """
    evaluations = compare.read_evaluations(group)
    pairs = compare.choose_pairs(evaluations)
    if not pairs:
        return None
    # Pairs whose reference is an initial network.
    initial = [pair for pair in pairs if group[pair[1]][0].run.method == summary.INITIAL]
    method, base = (initial or pairs)[-1]
    scored = group[method][0]
    names = ("before hardening", "after hardening") if initial else (base, method)
    subjects = NETWORKS if initial else (f"the network “{base}”", f"the network “{method}”")
    label = join_words([in_words(name) for name in scored.scores.labels], "or")
    images = images_folder(scored.run, scored.name)
    rows = {}
    if images is not None:
        rows = contrasts(
            group[base][0].folder,
            scored.folder,
            images,
            scored.scores.labels,
            subjects,
        )
    compared = Compared(
        label=label,
        before=evaluations[base],
        after=evaluations[method],
        names=names,
        subjects=subjects,
        change="hardening" if initial else f"“{method}”",
        place=place_of(images, scored.name),
        trained_objects=_classes_with_trained_objects(scored, images),
    )
    return compare_networks(compared, rows)


def _classes_with_trained_objects(scored: ScoredRun, images: Path | None) -> list[str]:
    """List the classes whose images show the objects of the training.

    A run renders its own test images. A class without generated solids has no
    other objects than those of the training.

    Args:
        scored: A run with its scores.
        images: Folder of the images that were scored. None if it is unknown.

    Returns:
        Names of the classes in words.
    """
    if images != scored.run.folder / KEPT_ASIDE:
        return []
    labels = scored.scores.labels
    return [in_words(label) for label in labels if not can_be_generated(label)]


def images_folder(run: RunSummary, name: str) -> Path | None:
    """Find the folder of the images that a run was scored on.

    Args:
        run: A finished run.
        name: Name of the folder of its scores.

    Returns:
        Folder of the images. None if the configuration does not name it, or if
        it has been moved.
    """
    photos = OmegaConf.select(run.config, "evaluate.photos")
    named = photos if isinstance(photos, Mapping) else {PHOTOGRAPHS: photos}
    folder = named.get(name)
    if not folder:
        rendered = run.folder / KEPT_ASIDE
        return rendered if name == LABORATORY and rendered.is_dir() else None
    start = run.config.get("working_folder") or ""
    candidates = (published(Path(folder)), Path(start) / folder)
    return next(filter(Path.is_dir, candidates), None)


def scores_section(title: str, group: Scored) -> dict[str, Any]:
    """Collect the plots, tables and images of runs that were scored on the same images.

    Args:
        title: Title of the images.
        group: Scored runs of each method, from `summary.group_by_images`.

    Returns:
        Values of the macro `scores` in page.html.jinja:

        - "name": the title;
        - "sheets": contact sheet of the first run of each method;
        - "rocs": plots of ROC curves;
        - "tables": tables of metrics and of their differences;
        - "problem": why the differences are unknown, or an empty text.
    """
    sheets = {}
    for method, scored_runs in group.items():
        path = scored_runs[0].folder / CONTACT_SHEET
        alt = f"predictions of {method} on {title}"
        sheets[method] = plots.from_file(path, alt, SHEET_WIDTH)
    tables = [summary.score_table("", group)]
    rocs: list[Picture | None] = []
    problem = ""
    try:
        evaluations = compare.read_evaluations(group)
        if evaluations:
            rocs = _rocs(evaluations)
            tables += _evaluation_tables(evaluations)
            tables.append(compare.class_table(group))
    except InputError as error:
        problem = str(error)
    return {
        "name": title,
        "sheets": sheets,
        "rocs": rocs,
        "tables": [table.known for table in tables],
        "problem": problem,
    }


def _rocs(methods: compare.Evaluations) -> list[Picture | None]:
    """Plot the ROC curves of all images and, with several labels, of each label.

    Args:
        methods: Evaluations of each method on the same images.

    Returns:
        A plot with the curves of all methods for all images and for each label.
        None in place of a plot without positives or without negatives.
    """
    first_evaluation = next(iter(methods.values()))[0]
    pictures = []
    for part, pool in first_evaluation.pools.items():
        if not part.is_overall:
            continue
        scores = {}
        for method, evaluations in methods.items():
            scores[method] = [evaluation.pools[part].scores for evaluation in evaluations]
        pictures.append(plots.roc(scores, pool.label))
    return pictures


def _evaluation_tables(methods: compare.Evaluations) -> list[Table]:
    """Make the table of differences and, if there are parts of the images, the table of parts.

    Args:
        methods: Evaluations of each method. Each has a pool of all images, and
            a pool for each label and source, if the images have any.
    """
    tables = [compare.overall_differences(methods)]
    first_evaluation = next(iter(methods.values()))[0]
    if len(first_evaluation.pools) > 1:
        tables.append(compare.group_table(methods))
    return tables


def _attack(attack: summary.AttackSummary) -> dict[str, Any]:
    """Collect what runs.html.jinja shows of an attack.

    Args:
        attack: Attack with a row for each example.

    Returns:
        Mapping with these keys:

        - "folder": folder of the attack;
        - "rows": rows of all examples;
        - "checks": pairs of the name of a check and its result;
        - "images": pictures of some examples, by their title;
        - "config": configuration of the attack. Empty if there is no file.
    """
    images = {}
    for row in evenly_spaced(attack.rows, ATTACK_EXAMPLES):
        title = f"Example {row.number}, {row.label}: {row.outcome}"
        alt = f"{title}; before, after, their difference and the lights; "
        alt += f"predicted {row.before}, then {row.after}"
        path = attack.folder / f"example_{row.number:03d}.png"
        images[title] = plots.from_file(path, alt, SHEET_WIDTH)
    # The folder of an attack may have no config.yaml.
    config: Mapping[str, Any] = {}
    with suppress(InputError):
        config = read_config(attack.folder.parent / CONFIG)
    checks = []
    for name, value in attack.checks.items():
        if not isinstance(value, dict):
            checks.append((name.replace("_", " "), value))
    return {
        "folder": attack.folder,
        "rows": attack.rows,
        "checks": checks,
        "images": images,
        "config": config,
    }
