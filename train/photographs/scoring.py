"""Score a model on a folder of photographs: recall and false alarms of one class, and the files that tell of them."""

import json
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from train.photographs.answers import ANSWERS, Answer, ask, rank_classes, write_answers
from train.photographs.contact_sheet import choose_sections, draw_contact_sheet
from train.photographs.figures import OVERALL, Pool, figures, pool_answers, share_true
from train.photographs.folder import find_photographs, left_out, load_photographs, require_outside
from train.photographs.roc import draw_roc, rank_pools, write_roc_csv

SUMMARY = "summary.json"
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
) -> dict[str, Any]:
    """Ask the model about every photograph of a folder; write and return what came out.

    `model`, which lies on `device`, takes (N, 3, size, size) float32 sRGB in [0, 1] and gives logits
    (N, len(classes)); a module is put in eval mode and left as it was found. For `folder` and `label` see
    `find_photographs`.

    Written into `out`: photographs.csv, a row per photograph (probability and rank of the true class are
    empty for `other_*`); contact_sheet.png, hits, misses and false alarms; roc.csv and roc.png, the ROC curves
    overall and of each source that has both kinds; and summary.json, which is also returned:

    - n: photographs, label, others, unreadable, left_out; label; size; unreadable, left_out: their paths (see
      `left_out`);
    - recall, top5: of the photographs of class `label`, with their most_common_wrong answers;
    - false_alarms: the share of all others that are called `label`;
    - auc, recall_at: how well the log-odds of `label` tell its photographs from all others, as `rank` returns them;
    - by_class: n, recall, top5, called_label (the share called `label`) and most_common_wrong;
    - by_source: n, recall, top5, false_alarms, auc and recall_at, over the photographs whose source is known; they are
      ranked among the others of their source and of the sources that they name as look-alikes.

    Shares come with their 95 % Wilson intervals, as `share` returns them.

    Raises InputError as `find_photographs` and `load_photographs` do, for `out` inside `folder`, and for logits of
    another shape or not finite.
    """
    require_outside(out, folder)
    found = find_photographs(folder, classes, label)
    photographs, images, unreadable = load_photographs(folder, found, size, skip_unreadable)
    logits = ask(model, images, len(classes), batch_size, device)
    answers = rank_classes(photographs, logits, classes, label)
    pools = pool_answers(answers, label)
    others = [str(path) for path in left_out(folder)]
    summary = _summarize(answers, pools, label, size, unreadable, others)

    out.mkdir(parents=True, exist_ok=True)
    write_answers(out / ANSWERS, answers, label)
    text = json.dumps(summary, indent=2, ensure_ascii=False, allow_nan=False)
    (out / SUMMARY).write_text(text + "\n", encoding="utf-8", errors="backslashreplace")
    draw_contact_sheet(choose_sections(answers, images, label)).save(out / "contact_sheet.png")
    rankings = rank_pools(pools)
    write_roc_csv(out / "roc.csv", rankings)
    draw_roc(rankings, label).savefig(out / "roc.png")
    return summary


def _summarize(
    answers: Sequence[Answer],
    pools: Mapping[str, Pool],
    label: str,
    size: int,
    unreadable: Sequence[str],
    others: Sequence[str],
) -> dict[str, Any]:
    by_class = defaultdict(list)
    for answer in answers:
        by_class[answer.photograph.label].append(answer)
    whole = pools[OVERALL]
    return {
        "label": label,
        "size": size,
        "n": {
            "photographs": len(answers),
            "label": len(whole.mine),
            "others": len(whole.others),
            "unreadable": len(unreadable),
            "left_out": len(others),
        },
        **figures(whole, label),
        "most_common_wrong": _most_common_wrong(whole.mine),
        "by_source": {
            source: {"n": len(pool.mine) + len(pool.others), **figures(pool, label)}
            for source, pool in pools.items()
            if source != OVERALL
        },
        "by_class": {name: _class_figures(group, label) for name, group in sorted(by_class.items())},
        "unreadable": list(unreadable),
        "left_out": list(others),
    }


def _class_figures(answers: Sequence[Answer], label: str) -> dict[str, Any]:
    ranks = [answer.true_rank for answer in answers if answer.true_rank is not None]
    return {
        "n": len(answers),
        "recall": share_true(rank == 1 for rank in ranks),
        "top5": share_true(rank <= 5 for rank in ranks),
        "called_label": share_true(answer.prediction == label for answer in answers),
        "most_common_wrong": _most_common_wrong(answers),
    }


def _most_common_wrong(answers: Sequence[Answer]) -> dict[str, int]:
    counts = Counter(answer.prediction for answer in answers if answer.true_rank != 1)
    ordered = sorted(counts.items(), key=lambda item: (-item[1], item[0]))
    return dict(ordered[:WRONG_ANSWERS])
