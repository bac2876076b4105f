"""Write the report of an audit from the files with its results.

The folder of the audit has a subfolder of results for each network. A folder of
test images is either "laboratory", with path-traced renders, or "photographs".
Plain light is ordinary light, before an attack changes it.
"""

import base64
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

from train.auditing import network as audited
from train.auditing.lights import ADDITIONAL_STEPS, BOXED, DETECTED, KINDS, NORMALIZED, SIDE, STEPS
from train.auditing.network import IN_WORDS, AuditedNetwork, AuditReport, Recommendation
from train.auditing.relit import relit_sections, screen_of_photographs
from train.results import compare, first_screen
from train.results.metrics import Metrics
from train.results.page import scores_section, write_page
from train.results.pictures import Picture, plot_by_radius, plot_curves, read_square
from train.results.predictions import SUMMARY, Predictions
from train.results.tables import Estimate, Table, describe_intervals, format_interval, fraction
from train.run_config import CONFIG, read_config
from train.run_folder import read_json
from train.settings import in_words

# Headline of the report, by the answer to the question whether the network is safe.
VERDICTS = {
    "No": "It is not safe under unusual lighting.",
    "Perhaps not": "It may not be safe under unusual lighting; so few views show little.",
    "Unknown": "It is unknown whether it is safe.",
}
# JavaScript of the slider that moves a light from natural to attacked.
SLIDER_SCRIPT = (Path(__file__).parent / "slider.js").read_text(encoding="utf-8")
# Number of images in a gallery of the worst predictions.
WORST = 10
# Header of the table of metrics.
HEADER = {
    "recall": "recall",
    "ap50": "AP50",
    "false_per_image": "false detections per image",
    "miou": "mIoU",
}
# What is said about the metrics.
ABOUT = (
    "Recall at the score threshold, average precision at an IoU of 0.5, and detections of {} "
    "without an object."
)
ABOUT_PIXELS = "Mean of the IoU of the pixels of {} and of that of all other pixels."
# The audited network and the hardened one, if there is one.
Networks = Sequence[AuditedNetwork]


class Audited(NamedTuple):
    """Report of an audit.

    Attributes:
        path: Path of report.html.
        screen: Top of the report: its headline, main numbers and sentences.
        networks: Each network by the name of the subfolder with its results.
        recommendation: Recommended remedy. None if it is unknown.
    """

    path: Path
    screen: first_screen.FirstScreen
    networks: Mapping[str, AuditedNetwork]
    recommendation: Recommendation | None

    def report(self) -> AuditReport:
        """Collect the numbers of the audit."""
        networks = {key: network.report() for key, network in self.networks.items()}
        reports = networks[audited.CLASSIFIER], networks.get(audited.HARDENED)
        recommendation = "" if self.recommendation is None else self.recommendation.sentence
        page = self.path.read_text(encoding="utf-8")
        return AuditReport(self.networks[audited.CLASSIFIER].label, *reports, recommendation, page)


def write_audit_page(
    label: str,
    names: Mapping[str, str],
    remedies: Mapping[str, str],
    folders: Mapping[str, Path],
    out: Path,
    caveats: Sequence[str],
    missing: str = "",
) -> Audited:
    """Write report.html from the results in the folder of an audit.

    Keys of `names` and values of `remedies` are subfolders of `out` with results. Without meshes,
    `label` is empty. `missing` names what is not measured yet; `folders` are then without it.
    """
    # The folder with the results of each network, by its name.
    results = {name: out / key for key, name in names.items()}
    content: dict[str, Any] = {
        "about": " and ".join(results),
        "relit": relit_sections(results),
        "configs": {"configuration": read_config(out / CONFIG)},
    }
    if not label:
        screen = screen_of_photographs(results)
        title = "Audit: photographs in the light of a projector"
        path = write_page(out, title=title, screen=screen, lead=caveats, **content)
        return Audited(path, screen, {}, None)
    by_key = {key: AuditedNetwork(label, name, out / key) for key, name in names.items()}
    networks = [*by_key.values()]
    # The first kind of test images decides the top of the page and the recommendation.
    images = next(iter(folders), None)
    screen = _first_screen(networks, folders)
    recommendation = None
    if images is not None and len(remedies) > 1:
        # One evaluation of each remedy, since an audit has no seeds.
        evaluations = {
            name: [AuditedNetwork("", name, out / key).evaluation(images)]
            for name, key in remedies.items()
        }
        recommendation = audited.recommend(evaluations)
    is_unknown = networks[0 if folders else -1].verdict[0] == "Unknown"
    if is_unknown and recommendation is not None and recommendation.remedy is None:
        recommendation = replace(recommendation, sentence=audited.NEXT_TRAINING)
    advice = []
    if recommendation is not None:
        # The top of the report shows the gain by hardening already.
        is_shown = recommendation.remedy == audited.HARDENING
        advice = [audited.ADVICE[audited.HARDENING] if is_shown else recommendation.sentence]
    elif is_unknown:
        advice = [audited.NEXT_TRAINING]
    elif screen.answer in (VERDICTS["No"], VERDICTS["Perhaps not"]):
        advice = [audited.NEXT_DATA if len(networks) > 1 else audited.NEXT_HARDENING]
    note = [f"These are first results. Not measured yet: {missing}."] if missing else []
    screen = replace(screen, sentences=[*note, *screen.sentences, *advice])
    slider = _slider(networks)
    unreadable = []
    for name in folders:
        if files := read_json(networks[-1].folder / name / SUMMARY)["unreadable"]:
            text = f"{len(files)} of the {IN_WORDS[name]} cannot be read, such as {files[0]}."
            unreadable.append(text)
    path = write_page(
        out,
        title=f"Audit: {in_words(label)} under unusual lighting",
        label=in_words(label),
        kinds=KINDS,
        steps=(STEPS, ADDITIONAL_STEPS),
        networks=networks,
        plain_sentence=plain_sentence(networks[0]),
        pictures={network.name: attack_pictures(network) for network in networks},
        charts=charts(networks),
        slider=slider,
        script=SLIDER_SCRIPT if slider else "",
        photographs=_score_sections(by_key, remedies, out),
        recommendation=recommendation,
        worst=_worst(networks, folders),
        screen=screen,
        lead=[*caveats, *unreadable],
        detections=detection_sections(results, in_words(label)),
        **content,
    )
    return Audited(path, screen, by_key, recommendation)


def _slider(networks: Networks) -> dict[str, Any]:
    """Choose the first attack that succeeds for the slider, with titles. Empty if none does."""
    for network in networks:
        for kind, counts in network.counts.items():
            if "slider" in counts:
                classes = [in_words(label) for label in counts["slider"]["classes"]]
                for frame in counts["slider"]["frames"]:
                    frame["predicted"] = in_words(frame["predicted"])
                named = {"network": network.name, "light": KINDS[kind].title, "classes": classes}
                return counts["slider"] | named
    return {}


def _first_screen(networks: Networks, folders: Mapping[str, Path]) -> first_screen.FirstScreen:
    """Make the top of the report from the scores of one or two networks, or from their attacks."""
    metrics = [Metrics()] * len(networks)
    place = ""
    if folders:
        # The first screen shows the first folder alone.
        images, folder = next(iter(folders.items()))
        evaluations = [network.evaluation(images) for network in networks]
        if len(networks) > 1:
            names = (f"before: {networks[0].name}", f"after: {networks[1].name}")
            # Each side of the comparison is a list of evaluations, one for each seed.
            before, after = ([evaluation] for evaluation in evaluations)
            screen = first_screen.compare_networks(before, after, names, folder, folder.name)
            if screen is not None:
                return screen
        metrics = [item.pooled.metrics for item in evaluations]
        place = first_screen.describe_place(folder, folder.name)
    # Both are shown under the kind of lighting that fools the first network most.
    kind = networks[0].strongest_kind
    pairs = zip(networks, metrics, strict=True)
    first, *others = (screen_of_one(*pair, kind, place) for pair in pairs)
    if not others:
        return first
    # The answer is that of the hardened network.
    last = others[-1]
    # The other sentences of both repeat the numbers.
    sentences = [first.sentences[0], last.sentences[0]]
    known = {number.title: number.after for number in first.numbers}
    numbers = [
        replace(number, before=known[number.title])
        for number in last.numbers
        if number.title in known
    ]
    return replace(last, sentences=sentences, numbers=numbers, names=[*first.names, *last.names])


def _score_sections(
    networks: Mapping[str, AuditedNetwork], remedies: Mapping[str, str], out: Path
) -> list[dict[str, Any]]:
    """Collect the plots, tables and pictures of the scores on each folder of test images.

    The networks with the remedy "normalized light", which normalizes the colors of an image before
    the network classifies it, follow as, for example, "resnet50, normalized light".
    """
    runs = {network.name: [network.run] for network in networks.values()}
    for key in remedies.values():
        if key.endswith(NORMALIZED):
            name = f"{networks[key.removesuffix(NORMALIZED)].name}, normalized light"
            runs[name] = [AuditedNetwork("", name, out / key).run]
    return [scores_section(title, group) for title, group in compare.group_by_images(runs).items()]


def plain_sentence(network: AuditedNetwork) -> str:
    """Write how many views a classifier recognizes in plain light, before any attack."""
    label, name, plain = in_words(network.label), network.name, network.plain
    if plain.recognized == 0:
        none = f"{name} recognizes none of {plain.n} views of {label} in plain light"
        tried = "at any exposure and size that was tried"
        return f"{none}, {tried}. So this audit cannot tell what unusual light does."
    sentence = f"In plain light, {name} recognizes {plain.recognized} of {plain.n} views of {label}"
    # The search changed nothing, or found nothing better.
    if plain.recognized == plain.recognized_as_given:
        return f"{sentence}."
    found = f"in the light “{plain.light}” at exposure {plain.exposure:g}, size {plain.size:g}"
    before = f"before this search, {plain.recognized_as_given}"
    return f"{sentence} {found}; {before}. All lights are tested there."


def screen_of_one(
    network: AuditedNetwork, metrics: Metrics, kind: str | None, place: str
) -> first_screen.FirstScreen:
    """Make the top of the report of an audit of one network, with its scores on test images.

    It has the views that are left after attacks with this kind of lighting, if one is given. The
    text `place` says where the test images are from.
    """
    numbers = []
    sentences = [plain_sentence(network)]

    def show(title: str, value: Estimate, note: str = "higher is better") -> None:
        interval = describe_intervals([value])
        numbers.append(first_screen.ShownMetric(title, note, None, value, interval=interval))

    show("Views recognized in plain light", fraction(network.plain.recognized, network.plain.n))
    if kind is not None:
        light = KINDS[kind]
        # Views that are still recognized at the largest radius.
        kept = network.remaining(kind, "adversarial")[-1]
        show(f"Of these, under attack by {light.title}", kept)
        control = f"If an attacker controls {light.title} (radius {light.radii[-1]:g})"
        views = f"{kept.hits} of the {kept.n} views that it recognizes before the attack"
        sentences.append(f"{control}, it still recognizes {views}.")
    recall, mistaken = metrics.recall, metrics.false_positive_rate
    name = in_words(network.label)
    if mistaken.value is not None:
        show(f"Other objects called {name}", mistaken, "lower is better")
        if recall.value is not None:
            right = f"recognizes {recall.value:.0%} of {name}"
            wrong = f"calls {mistaken.value:.0%} of other objects “{name}”"
            sentences.append(f"{place}, it {right} and {wrong}.")
    short, _ = network.verdict
    return first_screen.FirstScreen(VERDICTS.get(short, short), sentences, numbers, [network.name])


def attack_pictures(network: AuditedNetwork) -> list[first_screen.ComparedImage]:
    """Make a pair of pictures for each kind of lighting: one view before and after the attack.

    A kind of lighting by which no attack succeeds has no pictures.
    """
    compared = []
    for kind, counts in network.counts.items():
        # Only a successful attack has an example to show.
        if "predicted" not in counts:
            continue
        light = KINDS[kind]
        predicted = zip(counts["predicted"], counts["confidence"], strict=True)
        texts = [f"{in_words(label)} {probability:.0%}" for label, probability in predicted]
        before, after = map(first_screen.ShownPrediction, texts, ("right", "wrong"))
        first, *_, last = counts["slider"]["frames"]
        pictures = [
            Picture(base64.b64decode(frame["image"]), "jpeg", f"{light.title}: {text}", SIDE)
            for frame, text in zip((first, last), texts, strict=True)
        ]
        lost = f"{counts['adversarial'][-1]} of {counts['correct']} views lost"
        caption = f"{light.title}: {lost} at radius {light.radii[-1]:g}"
        compared.append(first_screen.ComparedImage(pictures, caption, before, after))
    return compared


def charts(networks: Networks) -> list[Picture]:
    """Plot the fraction of recognized views against the radius of attacks.

    Each network has a line for the attack and one for random draws, unless it recognizes no view
    before the attack, or not all radii are measured.
    """
    pictures = []
    for kind, light in KINDS.items():
        lines = {
            network.name + end: network.remaining(kind, method)
            for network in networks
            if network.counts[kind]["correct"] and network.counts[kind]["random"]
            for end, method in (("", "adversarial"), (", random", "random"))
        }
        if lines:
            unit = f"radius ({light.unit})"
            # Radius 0 is before the attack.
            pictures.append(plot_by_radius(lines, (0, *light.radii), light.title, unit))
    return pictures


def _worst(networks: Networks, folders: Mapping[str, Path]) -> dict[str, list[Picture]]:
    """Make galleries of each network's WORST misses and false alarms in each folder."""
    galleries = {}
    for network, (images, folder) in product(networks, folders.items()):
        predictions = network.evaluation(images).pooled.predictions
        # Log-odds in ascending order: missed positives come first, and false alarms last.
        order = predictions.log_odds.argsort(kind="stable")
        is_positive = predictions.positive[order]
        label = in_words(network.label)
        for title, rows in (
            (f"{label} that {network.name} doubts most", order[is_positive]),
            (f"what {network.name} most takes for {label}", order[~is_positive][::-1]),
        ):
            shown = [_draw(predictions, row, folder) for row in rows[:WORST]]
            galleries[f"{title}, of the {IN_WORDS[images]}"] = shown
    return galleries


def _draw(predictions: Predictions, row: int, folder: Path) -> Picture:
    """Draw an image of a folder over its class, its source and what a network predicts."""
    photograph = predictions.photograph[row]
    subject = ", ".join(map(in_words, filter(None, (photograph.label, photograph.source))))
    caption = f"{subject}: {first_screen.describe_prediction(predictions, row).text}"
    return read_square(folder / photograph.path, SIDE, caption, caption)


def detection_sections(networks: Mapping[str, Path], label: str) -> list[dict[str, Any]]:
    """Make a section of a report about each network, whose results are in a folder."""
    made = []
    for name, folder in networks.items():
        if not (folder / DETECTED).exists():
            continue
        content = read_json(folder / DETECTED)
        tables = [_metrics_table(content["metrics"], "renders; 95% intervals over views", "light")]
        # The same network with the remedy "normalized light", which may have scores, too.
        normalized = folder.with_name(f"{folder.name}{NORMALIZED}")
        for path, end in ((folder, ""), (normalized, ", with normalized light")):
            if (path / BOXED / SUMMARY).exists():
                by_label = read_json(path / BOXED / SUMMARY)["by_label"]
                tables.append(_metrics_table(by_label, f"photographs{end}", "class"))
        chart = plot_curves({name: [content["curve"]]}, "recall", "false detections per image")
        # The curve of a detector that finds nothing is empty, like that of a segmenter.
        about = ABOUT if "recall" in content["metrics"]["plain light"] else ABOUT_PIXELS
        shown = {"tables": tables, "charts": [chart] if chart else []}
        made.append({"name": name, "about": about.format(label), **shown})
    return made


def _metrics_table(metrics_of: Mapping[str, Any], title: str, first: str) -> Table:
    """Make a table of metrics from a file, with a row for each light or class."""
    rows, names = [], []
    for name, metrics in metrics_of.items():
        names = [metric for metric in HEADER if metric in metrics]
        estimates = [Estimate(**metrics[metric]) for metric in names]
        rows.append([name, *map(format_interval, estimates)])
    return Table(title, [first, *(HEADER[metric] for metric in names)], rows)
