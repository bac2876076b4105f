"""Score a model on a folder of photographs: recall and false alarms of one class, and the files that tell of them."""

import csv
import json
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import astuple
from pathlib import Path, PurePath

import torch

from renderer.errors import InputError
from train.photographs.answers import Answer, ask, rank_classes
from train.photographs.contact_sheet import choose_sections, draw_contact_sheet
from train.photographs.folder import find_photographs, left_out, load_photographs
from train.photographs.shares import share

FORMULA = ("=", "+", "-", "@", "\t", "\r")
WRONG_ANSWERS = 5  # how many of the most common wrong answers are named


def evaluate_photographs(
    model: Callable[[torch.Tensor], torch.Tensor],
    classes: Sequence[str],
    folder: Path,
    label: str,
    out: Path,
    size: int = 32,
    skip_unreadable: bool = False,
    batch_size: int = 256,
    device: str | torch.device = "cpu",
) -> dict:
    """Ask the model about every photograph of a folder; write and return what came out.

    `model`, which lies on `device`, takes (N, 3, size, size) float32 sRGB in [0, 1] and gives logits
    (N, len(classes)); a module is put in eval mode and left as it was found. For `folder` and `label` see
    `find_photographs`.

    Written into `out`: photographs.csv, a row per photograph (probability and rank of the true class are
    empty for `other_*`); contact_sheet.png, hits, misses and false alarms; and summary.json, which is also
    returned:

    - n: photographs, label, others, unreadable, left_out; label; unreadable, left_out: their paths (see `left_out`);
    - recall, top5: of the photographs of class `label`, with their most_common_wrong answers;
    - false_alarms: the share of all others that are called `label`;
    - by_class: n, recall, top5, called_label (the share called `label`) and most_common_wrong;
    - by_source: n, recall, top5 and false_alarms, over the photographs whose source is known.

    Shares come with their 95 % Wilson intervals, as `share` returns them.

    Raises InputError as `find_photographs` and `load_photographs` do, for `out` inside `folder`, and for logits of
    another shape or not finite.
    """
    if out.resolve().is_relative_to(folder.resolve()):  # the contact sheet would be scored next time
        raise InputError(f"out={out} lies inside the photographs' folder: choose another")
    found = find_photographs(folder, classes, label)
    photographs, images, unreadable = load_photographs(folder, found, size, skip_unreadable)
    logits = ask(model, images, len(classes), batch_size, device)
    answers = rank_classes(photographs, logits, classes, label)
    summary = _summarise(answers, label, unreadable, [str(path) for path in left_out(folder)])

    out.mkdir(parents=True, exist_ok=True)
    _write_csv(out / "photographs.csv", answers, label)
    text = json.dumps(summary, indent=2, ensure_ascii=False, allow_nan=False)
    (out / "summary.json").write_text(text + "\n", encoding="utf-8", errors="backslashreplace")
    draw_contact_sheet(choose_sections(answers, images, label)).save(out / "contact_sheet.png")
    return summary


def _summarise(answers: Sequence[Answer], label: str, unreadable: Sequence[str], others: Sequence[str]) -> dict:
    by_class, by_source = defaultdict(list), defaultdict(list)
    for answer in answers:
        by_class[answer.photograph.label].append(answer)
        if answer.photograph.source is not None:
            by_source[answer.photograph.source].append(answer)
    mine = by_class.get(label, [])
    return {
        "label": label,
        "n": {
            "photographs": len(answers),
            "label": len(mine),
            "others": len(answers) - len(mine),
            "unreadable": len(unreadable),
            "left_out": len(others),
        },
        **_figures(answers, label),
        "most_common_wrong": _most_common_wrong(mine),
        "by_source": {
            source: {"n": len(group), **_figures(group, label)} for source, group in sorted(by_source.items())
        },
        "by_class": {name: _class_figures(group, label) for name, group in sorted(by_class.items())},
        "unreadable": list(unreadable),
        "left_out": list(others),
    }


def _figures(answers: Sequence[Answer], label: str) -> dict:
    mine = [answer for answer in answers if answer.photograph.label == label]
    others = [answer for answer in answers if answer.photograph.label != label]
    return {
        "recall": _share_true(answer.true_rank == 1 for answer in mine),
        "top5": _share_true(answer.true_rank <= 5 for answer in mine),
        "false_alarms": _share_true(answer.prediction == label for answer in others),
    }


def _class_figures(answers: Sequence[Answer], label: str) -> dict:
    ranks = [answer.true_rank for answer in answers if answer.true_rank is not None]
    return {
        "n": len(answers),
        "recall": _share_true(rank == 1 for rank in ranks),
        "top5": _share_true(rank <= 5 for rank in ranks),
        "called_label": _share_true(answer.prediction == label for answer in answers),
        "most_common_wrong": _most_common_wrong(answers),
    }


def _most_common_wrong(answers: Sequence[Answer]) -> dict[str, int]:
    counts = Counter(answer.prediction for answer in answers if answer.true_rank != 1)
    ordered = sorted(counts.items(), key=lambda item: (-item[1], item[0]))
    return dict(ordered[:WRONG_ANSWERS])


def _share_true(outcomes: Iterable[bool]) -> dict:
    outcomes = list(outcomes)
    return share(sum(outcomes), len(outcomes))


def _write_csv(path: Path, answers: Sequence[Answer], label: str) -> None:
    header = ["path", "label", "source", "prediction", "probability", "true_probability", "true_rank"]
    with path.open("w", newline="", encoding="utf-8", errors="backslashreplace") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(map(_cell, [*header, f"{label}_probability", f"{label}_rank"]))
        for answer in answers:
            photograph, *figures = astuple(answer)
            writer.writerow(map(_cell, [*photograph, *figures]))


def _cell(value: object) -> object:
    """A name that a spreadsheet would take for a formula, and run, begins with an apostrophe: it is text then."""
    is_formula = isinstance(value, str | PurePath) and str(value).startswith(FORMULA)
    return f"'{value}" if is_formula else value
