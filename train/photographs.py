"""Real photographs: find them in a folder, reduce them to the classifier's size, and score its answers."""

import csv
import difflib
import json
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import astuple, dataclass
from math import sqrt
from pathlib import Path, PurePosixPath
from statistics import NormalDist

import numpy as np
import torch
from PIL import Image, ImageOps

from renderer.errors import InputError
from train.contact_sheet import Section, Tile, draw_contact_sheet

SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".bmp", ".tif", ".tiff", ".gif")
FOREIGN = "other_"  # starts the name of a folder whose class the model lacks
TABLE = "photos.csv"
DECODED_SIZES = 16  # a JPEG is decoded no smaller than this multiple of the final size
TILES_PER_SECTION = 40
WRONG_ANSWERS = 5  # how many of the most common wrong answers are named


@dataclass(frozen=True)
class Photograph:
    """A picture: its path relative to the folder, its class (or `other_*`) and, where known, its source."""

    path: PurePosixPath
    label: str
    source: str | None


@dataclass(frozen=True)
class Answer:
    """What the model says of one photograph.

    Ranks count from 1, the model's prediction. The figures of the true class are None for a class that
    the model lacks. `asked` is the class that the evaluation is about.
    """

    photograph: Photograph
    prediction: str
    probability: float
    true_probability: float | None
    true_rank: int | None
    asked_probability: float
    asked_rank: int


# ---------------------------------------------------------------------------------------- finding


def find_photographs(folder: Path, classes: Sequence[str], label: str) -> list[Photograph]:
    """The pictures of a folder, sorted by path, each with its class.

    The folder either holds one sub-folder per class, named exactly as in `classes` (or `other_NAME` for a
    class the model lacks), or holds pictures only, which are then all of class `label`. Sub-folders are
    searched to any depth; hidden files are passed over. `photos.csv` in the folder, if there, gives sources
    by its columns `path` and `source_tag`.

    Raises InputError for a folder that is missing, empty or mixes both layouts, for a sub-folder or `label`
    that is no class, and for a `photos.csv` without those columns.
    """
    if label not in classes:
        raise InputError(f"label '{label}' is not a class of the model: did you mean '{_nearest(label, classes)}'?")
    paths = _picture_paths(folder)
    has_class_folders = _check_layout(folder, paths, classes)
    sources = _read_sources(folder / TABLE)
    return [Photograph(path, path.parts[0] if has_class_folders else label, sources.get(path)) for path in paths]


def _picture_paths(folder: Path) -> list[PurePosixPath]:
    if not folder.is_dir():
        fault = "is not a folder" if folder.exists() else "does not exist"
        raise InputError(f"{folder} {fault}: name a folder of photographs")
    below = ((file, PurePosixPath(file.relative_to(folder).as_posix())) for file in folder.rglob("*"))
    paths = [path for file, path in below if _is_picture(path) and file.is_file()]
    if not paths:
        raise InputError(f"{folder} holds no photographs: put some there ({', '.join(SUFFIXES)})")
    return sorted(paths)


def _is_picture(path: PurePosixPath) -> bool:
    return path.suffix.lower() in SUFFIXES and not any(map(_is_hidden, path.parts))


def _is_hidden(name: str) -> bool:
    return name.startswith(".")


def _check_layout(folder: Path, paths: Sequence[PurePosixPath], classes: Sequence[str]) -> bool:
    """Whether the folder is made of class folders; InputError if a name among them is wrong."""
    names = sorted(entry.name for entry in folder.iterdir() if entry.is_dir() and not _is_hidden(entry.name))
    for name in names:
        if name not in classes and not name.startswith(FOREIGN):
            raise InputError(
                f"{folder / name} is not named after a class of the model (the nearest is "
                f"'{_nearest(name, classes)}'): rename it, to {FOREIGN}{name} if the model lacks its class"
            )
    loose = [path for path in paths if len(path.parts) == 1]
    if names and loose:
        raise InputError(f"{folder / loose[0]} lies beside class folders: move it into the folder of its class")
    return bool(names)


def _nearest(name: str, classes: Sequence[str]) -> str:
    by_lower_case = {each.lower(): each for each in classes}
    return by_lower_case[difflib.get_close_matches(name.lower(), by_lower_case, n=1, cutoff=0)[0]]


def _read_sources(table: Path) -> dict[PurePosixPath, str]:
    if not table.is_file():
        return {}
    try:
        with table.open(newline="", encoding="utf-8-sig") as file:
            header, *rows = csv.reader(file)
        path, tag = header.index("path"), header.index("source_tag")
    except (ValueError, csv.Error) as error:  # no header, a column missing, not UTF-8, or not a table
        raise InputError(f"{table} cannot be used: make it UTF-8 with the columns path and source_tag") from error
    return {PurePosixPath(row[path]): row[tag] for row in rows if len(row) > max(path, tag) and row[tag]}


# ---------------------------------------------------------------------------------------- loading


def load_photographs(
    folder: Path, photographs: Sequence[Photograph], size: int = 32, skip_unreadable: bool = False
) -> tuple[list[Photograph], torch.Tensor, list[str]]:
    """Read photographs as the classifier sees them.

    Returns the photographs that could be read, their pictures as (N, 3, size, size) uint8 sRGB, and the paths
    of those that could not. Each picture is turned as its EXIF orientation says, brought to RGB (alpha over
    white, 16 bits to 8), cropped to its central square and reduced with Pillow's Lanczos filter, which widens
    with the reduction: detail too fine for `size` averages out rather than turning into false patterns, and
    of what fits the most is kept, which counts at 32 pixels.

    Raises InputError at broken or oversized pictures unless `skip_unreadable`, and if no picture can be read.
    """
    with ThreadPoolExecutor() as pool:  # Pillow releases the interpreter while it decodes and resizes
        read = pool.map(lambda photograph: _try_read(folder / photograph.path, size), photographs)
        results = dict(zip(photographs, read, strict=True))
    errors = {photograph: result for photograph, result in results.items() if isinstance(result, Exception)}
    kept = [photograph for photograph in photographs if photograph not in errors]
    if errors and not (kept and skip_unreadable):
        first, reason = next(iter(errors.items()))
        advice = ", or set evaluate.skip_unreadable=true to skip them" if kept else ""
        raise InputError(
            f"{len(errors)} of {len(photographs)} photographs cannot be read, the first being "
            f"{folder / first.path} ({reason}): replace them{advice}"
        )
    pixels = torch.from_numpy(np.stack([results[photograph] for photograph in kept]))
    return kept, pixels.permute(0, 3, 1, 2).contiguous(), [str(photograph.path) for photograph in errors]


def _try_read(path: Path, size: int) -> np.ndarray | Exception:
    try:
        return _read(path, size)
    except Exception as error:  # Pillow's decoders raise almost anything at a broken file
        return error


def _read(path: Path, size: int) -> np.ndarray:
    """One picture as (size, size, 3) uint8."""
    with Image.open(path) as image:
        # A large JPEG is decoded at 1/2, 1/4 or 1/8 of its size, several times faster.
        image.draft(None, (DECODED_SIZES * size, DECODED_SIZES * size))
        upright = ImageOps.exif_transpose(image)
    return np.asarray(ImageOps.fit(_to_rgb(upright), (size, size), Image.Resampling.LANCZOS))


def _to_rgb(image: Image.Image) -> Image.Image:
    if image.mode == "F":
        raise ValueError("floating-point pixels have no agreed white")
    if image.mode.startswith("I"):  # 16 bits per pixel, which Pillow would clip rather than scale
        image = Image.fromarray(np.clip(np.asarray(image) // 256, 0, 255).astype(np.uint8))
    if image.has_transparency_data:
        image = image.convert("RGBA")
        image = Image.alpha_composite(Image.new("RGBA", image.size, "white"), image)
    return image.convert("RGB")


# ---------------------------------------------------------------------------------------- scoring


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

    - n: photographs, label, others, unreadable; label; unreadable: their paths;
    - recall, top5: of the photographs of class `label`, with their most_common_wrong answers;
    - false_alarms: the share of all others that are called `label`;
    - by_class: n, recall, top5, called_label (the share called `label`) and most_common_wrong;
    - by_source: n, recall, top5 and false_alarms, over the photographs whose source is known.

    A share is {value, low, high, hits, n} with its 95 % Wilson interval; with n = 0 the first three are null.

    Raises InputError as `find_photographs` and `load_photographs` do, and for logits of another shape or not
    finite.
    """
    found = find_photographs(folder, classes, label)
    photographs, images, unreadable = load_photographs(folder, found, size, skip_unreadable)
    logits = _logits(model, images, batch_size, device)
    if logits.shape != (len(images), len(classes)):
        raise InputError(
            f"the model answers in shape {tuple(logits.shape)}, not {(len(images), len(classes))}: "
            "evaluate a checkpoint that was trained on these classes"
        )
    if not logits.isfinite().all():
        raise InputError("the model's logits are not finite: evaluate a checkpoint of a run that did not diverge")
    answers = _answers(photographs, logits, classes, label)
    summary = _summarise(answers, label, unreadable)

    out.mkdir(parents=True, exist_ok=True)
    _write_csv(out / "photographs.csv", answers, label)
    text = json.dumps(summary, indent=2, ensure_ascii=False, allow_nan=False)
    (out / "summary.json").write_text(text + "\n", encoding="utf-8")
    draw_contact_sheet(_sections(answers, images, label)).save(out / "contact_sheet.png")
    return summary


def _logits(model: Callable, images: torch.Tensor, batch_size: int, device: str | torch.device) -> torch.Tensor:
    with _in_eval_mode(model), torch.inference_mode():
        batches = [model(batch.to(device).float() / 255) for batch in images.split(batch_size)]
        return torch.cat(batches).float().cpu()


@contextmanager
def _in_eval_mode(model: Callable) -> Iterator[None]:
    modules = list(model.modules()) if isinstance(model, torch.nn.Module) else []
    modes = [module.training for module in modules]  # one by one: a frozen layer may differ from the whole
    try:
        for module in modules:
            module.training = False
        yield
    finally:
        for module, mode in zip(modules, modes, strict=True):
            module.training = mode


def _answers(
    photographs: Sequence[Photograph], logits: torch.Tensor, classes: Sequence[str], label: str
) -> list[Answer]:
    probabilities = logits.double().softmax(dim=1).numpy()
    # Ranks come from the logits, whose order survives where probabilities round to 0; ties go to the first.
    order = logits.argsort(dim=1, descending=True, stable=True)
    ranks = (order.argsort(dim=1) + 1).numpy()
    index = {name: column for column, name in enumerate(classes)}
    asked = index[label]
    answers = []
    for row, photograph in enumerate(photographs):
        true, best = index.get(photograph.label), int(order[row, 0])
        answers.append(
            Answer(
                photograph,
                prediction=classes[best],
                probability=float(probabilities[row, best]),
                true_probability=None if true is None else float(probabilities[row, true]),
                true_rank=None if true is None else int(ranks[row, true]),
                asked_probability=float(probabilities[row, asked]),
                asked_rank=int(ranks[row, asked]),
            )
        )
    return answers


def _summarise(answers: Sequence[Answer], label: str, unreadable: Sequence[str]) -> dict:
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
        },
        **_figures(answers, label),
        "most_common_wrong": _most_common_wrong(mine),
        "by_source": {
            source: {"n": len(group), **_figures(group, label)} for source, group in sorted(by_source.items())
        },
        "by_class": {name: _class_figures(group, label) for name, group in sorted(by_class.items())},
        "unreadable": list(unreadable),
    }


def _figures(answers: Sequence[Answer], label: str) -> dict:
    mine = [answer for answer in answers if answer.photograph.label == label]
    others = [answer for answer in answers if answer.photograph.label != label]
    return {
        "recall": _share(answer.true_rank == 1 for answer in mine),
        "top5": _share(answer.true_rank <= 5 for answer in mine),
        "false_alarms": _share(answer.prediction == label for answer in others),
    }


def _class_figures(answers: Sequence[Answer], label: str) -> dict:
    ranks = [answer.true_rank for answer in answers if answer.true_rank is not None]
    return {
        "n": len(answers),
        "recall": _share(rank == 1 for rank in ranks),
        "top5": _share(rank <= 5 for rank in ranks),
        "called_label": _share(answer.prediction == label for answer in answers),
        "most_common_wrong": _most_common_wrong(answers),
    }


def _most_common_wrong(answers: Sequence[Answer]) -> dict[str, int]:
    counts = Counter(answer.prediction for answer in answers if answer.true_rank != 1)
    ordered = sorted(counts.items(), key=lambda item: (-item[1], item[0]))
    return dict(ordered[:WRONG_ANSWERS])


def _share(outcomes: Iterable[bool]) -> dict:
    """The share of true outcomes with its 95 % Wilson score interval (Wilson 1927)."""
    outcomes = list(outcomes)
    hits, n = sum(outcomes), len(outcomes)
    if n == 0:
        return {"value": None, "low": None, "high": None, "hits": 0, "n": 0}
    return {
        "value": hits / n,
        "low": _wilson_low(hits, n),
        "high": 1 - _wilson_low(n - hits, n),
        "hits": hits,
        "n": n,
    }


def _wilson_low(hits: int, n: int) -> float:
    z = NormalDist().inv_cdf(0.975)
    return (hits + z * z / 2 - z * sqrt(hits * (n - hits) / n + z * z / 4)) / (n + z * z)


def _write_csv(path: Path, answers: Sequence[Answer], label: str) -> None:
    header = ["path", "label", "source", "prediction", "probability", "true_probability", "true_rank"]
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow([*header, f"{label}_probability", f"{label}_rank"])
        for answer in answers:
            photograph, *figures = astuple(answer)
            writer.writerow([*photograph, *figures])


# ---------------------------------------------------------------------------------------- showing


def _sections(answers: Sequence[Answer], images: torch.Tensor, label: str) -> list[Section]:
    """Hits, misses and false alarms."""
    asked = list(zip(answers, images.permute(0, 2, 3, 1).numpy(), strict=True))
    mine = [pair for pair in asked if pair[0].photograph.label == label]
    others = [pair for pair in asked if pair[0].photograph.label != label]
    hits = [pair for pair in mine if pair[0].prediction == label]
    misses = [pair for pair in mine if pair[0].prediction != label]
    alarms = [pair for pair in others if pair[0].prediction == label]
    return [
        _section(f"{label}, recognised: {len(hits)} of {len(mine)}", "#2e9e5b", hits),
        _section(f"{label}, called something else: {len(misses)} of {len(mine)}", "#d03b3b", misses),
        _section(f"other things called {label}: {len(alarms)} of {len(others)}", "#e8a317", alarms),
    ]


def _section(title: str, colour: str, asked: Sequence[tuple[Answer, np.ndarray]]) -> Section:
    """The surest answers first; where there are too many, evenly drawn down to the least sure."""
    ordered = sorted(asked, key=lambda pair: -pair[0].probability)
    if len(ordered) > TILES_PER_SECTION:
        title += f" ({TILES_PER_SECTION} drawn evenly from the surest to the least sure)"
        drawn = np.linspace(0, len(ordered) - 1, TILES_PER_SECTION).round().astype(int)
        ordered = [ordered[index] for index in drawn]
    return Section(title, colour, [Tile(picture, _caption(answer)) for answer, picture in ordered])


def _caption(answer: Answer) -> tuple[str, ...]:
    """The prediction and, where it is wrong, the true class below it."""
    said = f"{answer.probability:.0%} {answer.prediction}"
    if answer.true_rank == 1:
        return (said,)
    if answer.true_rank is None:
        return said, answer.photograph.label
    return said, f"{answer.true_probability:.0%} {answer.photograph.label}"


def format_summary(summary: dict) -> str:
    """The summary of `evaluate_photographs` as aligned plain text, without a newline at the end."""
    label, n = summary["label"], summary["n"]
    overall_rows = [
        ("", "recall", "top-5", "false alarms"),
        *(
            (name, *(_interval(figures[key]) for key in ("recall", "top5", "false_alarms")))
            for name, figures in [("overall", summary), *summary["by_source"].items()]
        ),
    ]
    class_rows = [
        ("class", "n", "recall", "top-5", f"called {label}", "most common wrong answers"),
        *(
            (
                name,
                str(figures["n"]),
                *(_value(figures[key]) for key in ("recall", "top5", "called_label")),
                ", ".join(f"{answer} {count}" for answer, count in figures["most_common_wrong"].items()),
            )
            for name, figures in summary["by_class"].items()
        ),
    ]
    paragraphs = [
        f"{n['label']} photographs of {label}, {n['others']} of other things",
        _table(overall_rows, "<>>>"),
        _table(class_rows, "<>>>><"),
    ]
    if summary["unreadable"]:
        paragraphs.append(f"{n['unreadable']} unreadable: {', '.join(summary['unreadable'])}")
    return "\n\n".join(paragraphs)


def _value(share: dict) -> str:
    return "-" if share["n"] == 0 else f"{share['value']:.3f}"


def _interval(share: dict) -> str:
    if share["n"] == 0:
        return "-"
    return f"{share['hits']}/{share['n']} = {share['value']:.3f} [{share['low']:.3f}, {share['high']:.3f}]"


def _table(rows: Sequence[Sequence[str]], alignment: str) -> str:
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join(
        "  ".join(f"{cell:{side}{width}}" for cell, side, width in zip(row, alignment, widths, strict=True)).rstrip()
        for row in rows
    )
