"""The page report.html, which shows runs and attacks. It loads no other file."""

import base64
import hashlib
import shlex
import traceback
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from statistics import fmean
from typing import Any

from omegaconf import OmegaConf

from augment.augmentation_settings import MODES
from renderer.errors import InputError
from renderer.io.files import atomic_write
from train.data.photo import DESCRIPTION
from train.results import compare, first_screen, store, tables
from train.results.pictures import Picture, evenly_spaced, plot_curves, plot_roc, read_pictures
from train.results.predictions import CONTACT_SHEET
from train.results.store import Methods, RunSummary, Scored
from train.run_config import CONFIG, read_config
from train.run_folder import RENDERS, attack_success
from train.settings import KEPT_ASIDE, LABORATORY, PHOTOGRAPHS, in_light, in_words, published_folder
from train.system import user_message

# File name of the page.
PAGE = "report.html"
# Largest number of methods in plots and comparisons. A method is a way to train a
# network.
MAX_METHODS = 6
# Largest number of runs of a method, with different seeds, in plots and comparisons.
MAX_SEEDS = 5
# Largest number of sources or classes of images in a table.
MAX_GROUPS = 30
# Largest number of attacks for which the page shows images.
MAX_ATTACKS = 12
# Largest number of examples for which the page shows images, of each attack.
ATTACK_EXAMPLES = 4
# Largest number of epochs for which the page shows renders.
SHOWN_EPOCHS = 3
# Largest width of an image with a grid of renders, in pixels.
GRID_WIDTH = 720
# Largest width of a contact sheet and of an image of an attack, in pixels.
SHEET_WIDTH = 1100
# What a page shows, from its top to its end, if it is about this. The template has the same order.
BLOCKS = (
    *("screen", "networks", "recommendation", "lead", "attacks", "slider", "charts", "detections"),
    *("photographs", "methods", "unfinished", "curves", "relit", "renders", "examples", "worst"),
    *("configs", "shown"),
)
# Titles of the plots by epoch, and functions that read their values from the metrics of an epoch.
CURVES: dict[str, Callable[[Mapping[str, float]], float | None]] = {
    "training accuracy": lambda epoch: epoch.get("train/accuracy"),
    "validation accuracy": lambda epoch: epoch.get("validation/accuracy"),
    "attack success on clean-correct renders": lambda epoch: attack_success(epoch, "augment/"),
}


def write_report(
    folders: Sequence[Path], out: Path
) -> tuple[Path, first_screen.FirstScreen | None]:
    """Write the page of the runs and attacks in folders and below them.

    A run or attack that cannot be read is listed on the page. Return the path of the page and its
    first screen, which is None if no two networks can be compared.
    """
    found = store.find(folders)
    methods = store.group_by_method(found.runs)
    # Methods and runs that plots and comparisons show.
    shown = {name: runs[:MAX_SEEDS] for name, runs in [*methods.items()][:MAX_METHODS]}
    # One training run of each method, whose renders are shown. Only such runs have epochs.
    first = {method: runs[0] for method, runs in shown.items() if runs[0].epochs}
    groups = compare.group_by_images(shown)
    screen = _first_screen(groups)
    configs = {f"configuration of {name}": runs[0].config for name, runs in methods.items()}
    path = write_page(
        out,
        about=_about(found, folders),
        methods=methods,
        title=_title(found, methods),
        screen=screen,
        lead=[sentence for item in methods.items() for sentence in _accuracy_sentences(*item)],
        tables=[table for table in compare.run_tables(methods) if table.rows],
        captions=MODES,
        unfinished=found.unfinished,
        curves=_plot_metrics(shown),
        photographs=[scores_section(title, group) for title, group in groups.items()],
        renders={method: _read_renders(run, "epoch", "Renders") for method, run in first.items()},
        examples={
            method: _read_renders(run, "attacks", "Renders before and after")
            for method, run in first.items()
        },
        attacks=found.attacks,
        shown=[_attack_section(attack) for attack in found.attacks[:MAX_ATTACKS]],
        configs={title: config for title, config in configs.items() if config},
    )
    return path, screen


def _about(found: store.Findings, folders: Sequence[Path]) -> str:
    """Write the line below the title of the page."""
    counts = {
        "finished runs": len(found.runs),
        "unfinished or unreadable": len(found.unfinished),
        "attacks": len(found.attacks),
    }
    shown = ", ".join(f"{count} {words}" for words, count in counts.items() if count)
    return f"{shown}; in {', '.join(map(str, folders))}"


def _title(found: store.Findings, methods: Methods) -> str:
    """Write the title of the page."""
    if not methods:
        return "Attacks" if found.attacks else "Unfinished runs"
    # Positive classes of all runs.
    stored = [scores for runs in methods.values() for scores in runs[0].photographs.values()]
    labels = {label for scores in stored for label in scores.labels}
    modes = {method: runs[0].mode for method, runs in methods.items()}
    # A run that began with a network hardened it.
    if labels and store.INITIAL in modes.values():
        return f"Hardened against unusual lighting: {', '.join(map(in_words, sorted(labels)))}"
    subject = " and ".join(sorted(labels)) or "Networks"
    rendered = [method for method, mode in modes.items() if mode in MODES and mode != "none"]
    if not rendered:
        return f"{subject}: {', '.join(methods)}"
    return f"{subject}, trained with renders: {', '.join(rendered)}"


def write_page(out: Path, script: str = "", **content: Any) -> Path:
    """Write report.html with those of BLOCKS, in this order, that `content` has.

    `content` needs `title` and `about`, the line below the title. The browser runs no other script
    than `script`.
    """
    # This import takes time, and a training run needs it only at its end.
    from jinja2 import Environment, PackageLoader, StrictUndefined

    loader = PackageLoader("train.results", ".")
    options: dict[str, Any] = {"autoescape": True, "trim_blocks": True, "lstrip_blocks": True}
    environment = Environment(loader=loader, undefined=StrictUndefined, **options)
    environment.filters.update(as_text=tables.as_text, fraction=tables.fraction)
    environment.filters.update(hits=tables.format_fraction, interval=tables.format_interval)
    environment.filters.update(command=_shell_command, yaml=OmegaConf.to_yaml)
    # The base64 SHA-256 with which the content security policy allows the script.
    allowed = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    # Blocks without content are empty.
    content = {name: {} for name in BLOCKS} | content | {"script": script, "allowed": allowed}
    out.mkdir(parents=True, exist_ok=True)
    path = out / PAGE
    atomic_write(path, environment.get_template("page.html.jinja").render(content))
    return path


def report_of(folders: Sequence[Path], out: Path) -> str:
    """Write the page of finished runs, and describe it for the console.

    The text says why if the page cannot be written. No error is raised: the runs are finished and
    saved, so their command must not fail. A paragraph before the path says what hardening changed,
    if that was measured.
    """
    try:
        path, screen = write_report(folders, out)
        changed = [] if screen is None else [" ".join([screen.answer, *screen.sentences])]
        return "\n".join([*changed, f"report: {path}"])
    except Exception as error:
        return f"no report: {user_message(error) or traceback.format_exc()}"


def _shell_command(config: Mapping[str, Any]) -> str:
    """Return the lines `cd FOLDER` and COMMAND that repeat a run, or "" if none is recorded."""
    folder = config.get("working_folder")
    command = config.get("command") or ""
    return f"cd {shlex.quote(folder)}\n{command}" if folder and command else command


def _plot_metrics(methods: Methods) -> list[Picture]:
    """Plot accuracies by epoch, and the success of attacks on renders in training."""
    pictures = []
    for title, read in CURVES.items():
        # Each run of a method has a line, which is a list of pairs (epoch, metric).
        lines = {
            method: [[(epoch["epoch"], read(epoch)) for epoch in run.epochs] for run in runs]
            for method, runs in methods.items()
        }
        pictures.append(plot_curves(lines, title))
    return [picture for picture in pictures if picture is not None]


def _read_renders(run: RunSummary, kind: str, title: str) -> list[Picture]:
    """Read images of the training renders of the first, the middle and the last epoch of a run."""
    path_of_epoch = {
        int(path.stem.removeprefix(f"{kind}_")): path
        for path in (run.folder / RENDERS).glob(f"{kind}_*.png")
    }
    pictures = []
    for epoch in evenly_spaced(sorted(path_of_epoch), SHOWN_EPOCHS):
        alt = f"{title}, epoch {epoch}, {run.mode}"
        pictures += read_pictures(path_of_epoch[epoch], alt, GRID_WIDTH, f"epoch {epoch}")
    return pictures


def _accuracy_sentences(method: str, runs: Sequence[RunSummary]) -> list[str]:
    """Compare a method with the network that it began with, on the test images."""

    def mean(name: str) -> float | None:
        values = [run.scores[name] for run in runs if name in run.scores]
        return fmean(values) if values else None

    sentences = []
    accuracies = [run.before.accuracy or 0.0 for run in runs if run.before]
    # If the agreement with the original network was measured, it is told instead of the accuracy.
    if (agreement := mean("test/agreement")) is not None:
        place = "on photographs that training did not use"
        share = f"the same class as the original in {agreement:.1%} of the cases"
        sentences.append(f"{method}: {place}, the network predicts {share}.")
    elif accuracies:
        images = runs[0].config.get("test_images", "the test images")
        change = f"from {fmean(accuracies):.1%} to {mean('test/accuracy'):.1%}"
        sentence = f"{method[0].upper()}{method[1:]}: accuracy went {change} on {images}."
        # Without photographs, nothing shows the price of hardening on real images.
        is_rendered = OmegaConf.select(runs[0].config, "data.name") == "shapes"
        folders = [images_folder(run, name) for run in runs for name in run.photographs]
        if is_rendered and all(folder and (folder / DESCRIPTION).is_file() for folder in folders):
            sentence += " These are renders. No photographs were scored (setting photos), "
            sentence += "so the price on photographs is unknown."
        sentences.append(sentence)
    if (after := mean("test/relit_agreement_after")) is not None:
        light = in_light(OmegaConf.select(runs[0].config, "train.augmentation"))
        kept = f"{after:.1%} of the predictions are those for the unchanged photographs"
        before = f"and {mean('test/relit_agreement_before'):.1%} before"
        sentences.append(f"{method}: for photographs {light}, {kept}, {before}.")
    return sentences


def _first_screen(groups: Mapping[str, Scored]) -> first_screen.FirstScreen | None:
    """Make the first screen from the first images on which two networks were scored.

    It compares the last pair of a method and the network that it began with, or else the last pair.
    """
    for group in groups.values():
        with suppress(InputError):
            evaluations = compare.read_evaluations(group)
            pairs = compare.choose_pairs(evaluations)
            # Pairs whose second network is the one that the training began with.
            hardened = [pair for pair in pairs if group[pair[1]][0].run.mode == store.INITIAL]
            if not pairs:
                continue
            method, base = (hardened or pairs)[-1]
            names = (store.BEFORE_HARDENING, store.AFTER_HARDENING) if hardened else (base, method)
            # All runs of a method have the same images, so the first one stands for all.
            run, name = group[method][0]
            compared = evaluations[base], evaluations[method], names
            images = images_folder(run, name)
            # The folder of scores of a network without a run does not name the images.
            name = name if run.config else ""
            screen = first_screen.compare_networks(*compared, images, name, bool(hardened))
            if screen is not None:
                return screen
    return None


def images_folder(run: RunSummary, name: str) -> Path | None:
    """Find the folder of the images on which a run was scored.

    None if the configuration does not name it, or if it has been moved.
    """
    photos = OmegaConf.select(run.config, "photos")
    folder = (photos if isinstance(photos, Mapping) else {PHOTOGRAPHS: photos}).get(name)
    # The run may have rendered the images itself.
    candidates = [run.folder / KEPT_ASIDE] if name == LABORATORY else []
    if folder:
        # A relative path is relative to the folder in which the run was started.
        working_folder = Path(run.config.get("working_folder") or "")
        candidates = [working_folder / folder, published_folder(Path(folder))]
    return next(filter(Path.is_dir, candidates), None)


def scores_section(title: str, group: Scored) -> dict[str, Any]:
    """Collect the content of a section of the page about the scores on the same images.

    The keys are those that the macro `scores` of page.html.jinja reads.
    """
    sheets = {}
    for method, scored in group.items():
        alt = f"predictions of {method} on {title}"
        sheets[method] = read_pictures(scored[0].folder / CONTACT_SHEET, alt, SHEET_WIDTH)
    shown = [compare.score_table("", group)]
    rocs: list[Picture | None] = []
    problem = ""
    try:
        evaluations = compare.read_evaluations(group)
        if evaluations:
            first_evaluation = next(iter(evaluations.values()))[0]
            # A plot of ROC curves for all images, and one for each positive class.
            for subset in first_evaluation.rows():
                scores = {
                    method: [pool.scores for item in items if (pool := item.find(subset))]
                    for method, items in evaluations.items()
                }
                label = subset.name or " or ".join(first_evaluation.pooled.predictions.labels)
                rocs.append(plot_roc(scores, f"{label}, {title.partition(':')[0]}"))
            shown.append(compare.difference_table(evaluations))
            shown += [
                compare.group_table(evaluations, by)
                for by in ("source", "class")
                if 1 < len(first_evaluation.pooled.groups(by)) <= MAX_GROUPS
            ]
    except InputError as error:
        problem = str(error)
    known = [table.without_unknown_columns for table in shown]
    return {"name": title, "sheets": sheets, "rocs": rocs, "tables": known, "problem": problem}


def _attack_section(attack: store.AttackSummary) -> dict[str, Any]:
    """Collect the content of a section of the page about an attack."""
    images = {}
    for number, label, before, after, outcome in evenly_spaced(attack.rows, ATTACK_EXAMPLES):
        title = f"Example {number}, {label}: {outcome}"
        alt = f"{title}; before, after, their difference and the lights; "
        alt += f"predicted {before}, then {after}"
        images[title] = read_pictures(attack.folder / f"example_{number:03d}.png", alt, SHEET_WIDTH)
    # The folder of an attack may have no config.yaml.
    config: Mapping[str, Any] = {}
    with suppress(InputError):
        config = read_config(attack.folder.parent / CONFIG)
    return {**vars(attack), "images": images, "config": config}
