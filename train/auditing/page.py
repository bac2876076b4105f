"""Write the report of an audit from the files with its results.

The folder of the audit has a subfolder of results for each network. A folder of
test images is either "laboratory", with path-traced renders, or "photographs".
Plain light is ordinary light, before an attack changes it.
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from PIL import Image

from renderer.io.images import read_square
from train.auditing.lights import ADDITIONAL_STEPS, KINDS, SIDE, STEPS, PlainViews
from train.auditing.network import IN_WORDS, PHOTOGRAPHS, PLAIN, AuditedNetwork, AuditReport
from train.auditing.relit import relit_sections
from train.auditing.remedies import (
    CLASSIFIER,
    HARDENED,
    HARDENING,
    NEXT_HARDENING,
    NORMALIZED,
    Recommendation,
    recommend,
)
from train.results import compare
from train.results.first_screen import (
    NETWORKS,
    Compared,
    ComparedImage,
    FirstScreen,
    ShownMetric,
    ShownPrediction,
    choose_disagreements,
    compare_networks,
    describe_place,
    describe_prediction,
)
from train.results.metrics import Pool
from train.results.page import scores_section, write_page
from train.results.pictures import Picture, encode_picture, plot_by_radius, read_pictures
from train.results.predictions import SUMMARY, Prediction
from train.results.store import RunSummary, ScoredRun
from train.results.tables import Estimate, Proportion, fraction
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
# Width of the picture that shows a view before and after an attack, in pixels.
PAIR_WIDTH = 400


class Audited(NamedTuple):
    """Report of an audit.

    Attributes:
        path: Path of report.html.
        screen: Top of the report: its headline, main numbers and sentences.
        label: Class whose objects were tested.
        networks: Each network by the name of the subfolder with its results.
        recommendation: Recommended remedy. None if it is unknown.
    """

    path: Path
    screen: FirstScreen
    label: str
    networks: Mapping[str, AuditedNetwork]
    recommendation: Recommendation | None

    def report(self) -> AuditReport:
        """Collect the numbers of the audit."""
        networks = {key: network.report() for key, network in self.networks.items()}
        recommended = self.recommendation
        return AuditReport(
            label=self.label,
            network=networks[CLASSIFIER],
            hardened=networks.get(HARDENED),
            recommendation="" if recommended is None else recommended.sentence,
            page=self.path.read_text(encoding="utf-8"),
        )


def write_audit_page(
    label: str,
    names: Mapping[str, str],
    remedies: Mapping[str, str],
    folders: Mapping[str, Path],
    out: Path,
    caveats: Sequence[str],
) -> Audited:
    """Write report.html from the results in the folder of an audit.

    Keys of `names` and values of `remedies` are subfolders of `out` with results.
    """
    by_key = {key: AuditedNetwork(label, name, out / key) for key, name in names.items()}
    networks = [*by_key.values()]
    counts = {network.name: network.counts for network in networks}
    compared = networks if len(networks) > 1 else []
    transfers = {network.name: network.transfers for network in compared}
    plain = plain_sentence(networks[0], _plain_views(out))
    images = next(iter(folders), None)
    screen = _first_screen(networks, images, folders, plain)
    recommendation = None
    if images is not None and len(remedies) > 1:
        runs = {name: _scored_run(name, out / key) for name, key in remedies.items()}
        recommendation = recommend(_evaluate(runs, images))
    if recommendation is not None:
        sentence = recommendation.sentence
        if recommendation.remedy == HARDENING:
            # The top of the report shows the gain by hardening already.
            sentence = recommendation.advice
        screen = replace(screen, sentences=[*screen.sentences, sentence])
    elif screen.answer in (VERDICTS["No"], VERDICTS["Perhaps not"]):
        screen = replace(screen, sentences=[*screen.sentences, NEXT_HARDENING])
    slider = _slider(counts)
    path = write_page(
        out,
        "audit.html.jinja",
        title=f"Audit: {in_words(label)} under unusual lighting",
        about=" and ".join(counts),
        label=in_words(label),
        kinds=KINDS,
        steps=(STEPS, ADDITIONAL_STEPS),
        counts=counts,
        correct={network.name: network.recognized for network in networks},
        plain_sentence=plain,
        pictures={network.name: attack_pictures(network) for network in networks},
        withstood={network.name: network.withstood for network in networks},
        charts=charts(networks),
        slider=slider,
        script=SLIDER_SCRIPT if slider else "",
        transfers=transfers,
        answers=[network.answer for network in networks],
        photographs=_score_sections(by_key, remedies, out),
        recommendation=recommendation,
        rates={network.name: network.rates for network in networks},
        worst=_worst(networks, folders),
        screen=screen,
        caveats=[*caveats, *_unreadable_caveats(folders, networks[-1].folder)],
        agreement=_agreement(networks) if PHOTOGRAPHS in folders else fraction(0, 0),
        relit=relit_sections({network.name: network.folder for network in networks}),
        config=read_config(out / CONFIG),
    )
    return Audited(path, screen, label, by_key, recommendation)


def _plain_views(out: Path) -> PlainViews:
    """Read in which plain light all networks of an audit are tested."""
    return PlainViews(**read_json(out / CLASSIFIER / PLAIN))


def _scored_run(name: str, folder: Path) -> RunSummary:
    """Read the scores of a network, which may be a remedy without other results."""
    return AuditedNetwork("", name, folder).run


def _evaluate(runs: Mapping[str, RunSummary], images: str) -> compare.Evaluations:
    """Read the predictions of several networks for the same images."""
    return compare.read_evaluations({name: [ScoredRun(run, images)] for name, run in runs.items()})


def _slider(counts: Mapping[str, Mapping[str, Any]]) -> dict[str, Any] | None:
    """Choose the attack that the slider of the report shows, the first that succeeds.

    "network" and "light" of the result are titles. None if no attack succeeds.
    """
    for name, counts_of_network in counts.items():
        for kind, attack_counts in counts_of_network.items():
            if "slider" in attack_counts:
                slider = attack_counts["slider"]
                classes = [in_words(label) for label in slider["classes"]]
                named = {"network": name, "light": KINDS[kind].title, "classes": classes}
                return {**slider, **named}
    return None


def _first_screen(
    networks: Sequence[AuditedNetwork],
    images: str | None,
    folders: Mapping[str, Path],
    plain: str,
) -> FirstScreen:
    """Make the top of the report: its headline, main numbers and sentences.

    With two networks and test images, it compares the scores of the networks.
    Otherwise it describes the first network.
    """
    if images is None:
        return screen_of_one(networks[0], plain, None)
    evaluations = _evaluate({network.name: network.run for network in networks[:2]}, images)
    if len(networks) > 1:
        screen = _compare(networks, evaluations, folders[images])
        if screen is not None:
            return screen
    (evaluation,) = evaluations[networks[0].name]
    return screen_of_one(networks[0], plain, evaluation.pooled.all)


def _compare(
    networks: Sequence[AuditedNetwork], evaluations: compare.Evaluations, images: Path
) -> FirstScreen | None:
    """Make the top of a report that compares a network with its hardened version."""
    original, hardened = evaluations.values()
    label = networks[0].label
    compared = Compared(
        label=in_words(label),
        before=original,
        after=hardened,
        names=(f"before: {networks[0].name}", f"after: {networks[1].name}"),
        subjects=NETWORKS,
        place=describe_place(images, images.name),
    )
    before, after = (item.pooled.predictions for (item,) in evaluations.values())
    return compare_networks(compared, choose_disagreements(before, after, images, [label]))


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
            runs[name] = [_scored_run(name, out / key)]
    return [scores_section(title, group) for title, group in compare.group_by_images(runs).items()]


def plain_sentence(network: AuditedNetwork, plain: PlainViews) -> str:
    """Write how many views a classifier recognizes in plain light, before any attack."""
    label, name = in_words(network.label), network.name
    counted = f"{plain.recognized} of {plain.n} views of {label}"
    if plain.recognized == 0:
        return (
            f"{name} recognizes none of {plain.n} views of {label} in plain light, at "
            "any exposure and size that was tried. So this audit cannot tell what unusual light "
            "does."
        )
    if plain.recognized == plain.recognized_as_given:
        return f"In plain light, {name} recognizes {counted}."
    place = f"in the light “{plain.light}” at exposure {plain.exposure:g}, size {plain.size:g}"
    return (
        f"In plain light, {name} recognizes {counted} {place}; before this search, "
        f"{plain.recognized_as_given}. All lights are tested there."
    )


def screen_of_one(network: AuditedNetwork, plain: str, pool: Pool | None) -> FirstScreen:
    """Make the top of the report of an audit of one network, with its scores on test images."""
    views = _plain_views(network.folder.parent)
    numbers = [
        ShownMetric(
            title="Views recognized in plain light",
            note="higher is better",
            before=None,
            after=fraction(views.recognized, views.n),
        )
    ]
    sentences = [plain]
    kind = network.strongest_kind
    if kind is not None:
        light = KINDS[kind]
        *_, (remaining, correct) = network.remaining(kind, "adversarial")
        title = f"Of these, under attack by {light.title}"
        kept = fraction(remaining, correct)
        numbers.append(ShownMetric(title, "higher is better", before=None, after=kept))
        sentences.append(
            f"If an attacker controls {light.title} (radius {light.radii[-1]:g}), it "
            f"still recognizes {remaining} of the {correct} views that it recognizes "
            "before the attack."
        )
    recall = pool.metrics.recall if pool else Proportion()
    mistaken = pool.metrics.false_positive_rate if pool else Proportion()
    name = in_words(network.label)
    if mistaken.value is not None:
        title = f"Other objects called {name}"
        numbers.append(ShownMetric(title, "lower is better", before=None, after=mistaken))
    if recall.value is not None and mistaken.value is not None:
        sentences.append(
            f"In the scored images, it recognizes {recall.value:.0%} of {name} and calls "
            f"{mistaken.value:.0%} of other objects “{name}”."
        )
    short, _ = network.verdict
    return FirstScreen(
        answer=VERDICTS.get(short, short),
        sentences=sentences,
        numbers=numbers,
        rows={},
        names=[network.name],
        images="",
    )


def _unreadable_caveats(images: Collection[str], folder: Path) -> Iterator[str]:
    """Yield a sentence about each folder of test images with files that cannot be read."""
    for name in images:
        files = read_json(folder / name / SUMMARY)["unreadable"]
        if files:
            images_in_words = IN_WORDS[name]
            yield f"{len(files)} of the {images_in_words} cannot be read, such as {files[0]}."


def _agreement(networks: Sequence[AuditedNetwork]) -> Proportion:
    """Compute the fraction of photographs for which all networks predict the same class."""
    by_network = [network.predictions(PHOTOGRAPHS) for network in networks]
    is_same = []
    for predictions in zip(*by_network, strict=True):
        is_same.append(len({item.predicted for item in predictions}) == 1)
    return fraction(sum(is_same), len(is_same))


def attack_pictures(network: AuditedNetwork) -> list[ComparedImage]:
    """Read a picture for each kind of lighting: one view before and after the attack.

    A kind of lighting by which no attack succeeds has no picture.
    """
    compared = []
    for kind, counts in network.counts.items():
        light = KINDS[kind]
        answers = _answers(counts)
        if not answers:
            continue
        path = network.folder / f"{kind}.png"
        alt_text = f"{light.title}: {answers[0].text}, after the attack {answers[1].text}"
        for picture in read_pictures(path, alt_text, PAIR_WIDTH):
            lost = f"{counts['adversarial'][-1]} of {counts['correct']} views lost"
            caption = f"{light.title}: {lost} at radius {light.radii[-1]:g}"
            compared.append(ComparedImage(picture, caption, *answers))
    return compared


def _answers(attack_counts: Mapping[str, Any]) -> list[ShownPrediction]:
    """Describe the right prediction before an attack and the wrong one after it, if it succeeds."""
    if "predicted" not in attack_counts:
        return []
    shown = zip(
        attack_counts["predicted"], attack_counts["confidence"], ("right", "wrong"), strict=True
    )
    return [ShownPrediction(f"{in_words(name)} {p:.0%}", verdict) for name, p, verdict in shown]


def charts(networks: Sequence[AuditedNetwork]) -> list[Picture]:
    """Plot the fraction of recognized views against the radius of attacks.

    Each network has a line for the attack and one for random draws, unless it recognizes no view
    before.
    """
    pictures = []
    for kind, light in KINDS.items():
        lines: dict[str, list[Estimate]] = {}
        for network in networks:
            if network.counts[kind]["correct"]:
                for end, method in (("", "adversarial"), (", random", "random")):
                    counts = network.remaining(kind, method)
                    lines[network.name + end] = [fraction(*pair) for pair in counts]
        if lines:
            unit = f"radius ({light.unit})"
            pictures.append(plot_by_radius(lines, (0, *light.radii), light.title, unit))
    return pictures


class _ScoredImage(NamedTuple):
    """Test image with the prediction of one network.

    Attributes:
        images: Name of the folder of test images, "laboratory" or
            "photographs".
        image_index: Index of the image in the folder.
        prediction: Prediction of the network for the image.
    """

    images: str
    image_index: int
    prediction: Prediction


def _worst(
    networks: Sequence[AuditedNetwork], folders: Mapping[str, Path]
) -> dict[str, list[Picture]]:
    """Make two galleries of each network: its WORST misses and its WORST false alarms."""
    galleries: dict[str, list[Picture]] = {}
    draw = partial(_draw_image, folders, networks)
    for network in networks:
        items = [
            _ScoredImage(images, index, prediction)
            for images in folders
            for index, prediction in enumerate(network.predictions(images))
        ]
        items.sort(key=lambda item: item.prediction.log_odds)
        positives = [item for item in items if item.prediction.positive]
        negatives = [item for item in reversed(items) if not item.prediction.positive]
        label = in_words(network.label)
        galleries[f"{label} that {network.name} doubts most"] = [*map(draw, positives[:WORST])]
        galleries[f"what {network.name} most takes for {label}"] = [*map(draw, negatives[:WORST])]
    return galleries


def _draw_image(
    folders: Mapping[str, Path], networks: Sequence[AuditedNetwork], item: _ScoredImage
) -> Picture:
    """Draw a test image with the predictions of all networks in its caption."""
    photograph = item.prediction.photograph
    texts = []
    for network in networks:
        prediction = network.predictions(item.images)[item.image_index]
        texts.append(f"{network.name}: {describe_prediction(prediction).text}")
    caption = f"{in_words(photograph.label)}, {photograph.source}: {'; '.join(texts)}"
    image = Image.fromarray(read_square(folders[item.images] / photograph.path, SIDE))
    return encode_picture(image, caption, caption)
