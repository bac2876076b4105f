"""The summary of an evaluation as text for the terminal."""

from collections.abc import Sequence
from typing import Any

from train.photographs.figures import RANKED, figure_title, find_figure

COUNTED = ("recall", "top5", "false_alarms")
NAMED = 10  # how many of the files that were left out


def format_summary(summary: dict[str, Any]) -> str:
    """The summary of `evaluate_photographs` as aligned plain text, without a newline at the end."""
    label, n = summary["label"], summary["n"]
    pools = {"overall": summary, **summary["by_source"]}
    share_rows = [
        ("", "recall", "top-5", "false alarms"),
        *(
            (name, *(_counted(figures[key]) for key in ("recall", "top5", "false_alarms")))
            for name, figures in pools.items()
        ),
    ]
    ranked_rows = [
        ("", *(figure_title(name, label) for name in RANKED)),
        *((name, *(format_interval(find_figure(figures, key)) for key in RANKED)) for name, figures in pools.items()),
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
        f"{n['label']} images of {label}, {n['others']} of other things",
        _table(share_rows, "<>>>"),
        _table(ranked_rows, "<>>>>"),
        _table(class_rows, "<>>>><"),
    ]
    if summary["unreadable"]:
        paragraphs.append(f"{n['unreadable']} unreadable: {', '.join(summary['unreadable'])}")
    if summary["left_out"]:
        shown = summary["left_out"][:NAMED]
        rest = ", ..." if len(summary["left_out"]) > NAMED else ""
        paragraphs.append(f"{n['left_out']} left out, of kinds that are not read: {', '.join(shown)}{rest}")
    return "\n\n".join(paragraphs)


def format_interval(figure: dict[str, Any]) -> str:
    """A figure's value and interval; "-" where it is unknown or absent."""
    if figure.get("value") is None:
        return "-"
    return f"{figure['value']:.3f} [{figure['low']:.3f}, {figure['high']:.3f}]"


def _value(share: dict[str, Any]) -> str:
    return "-" if share["n"] == 0 else f"{share['value']:.3f}"


def _counted(share: dict[str, Any]) -> str:
    return "-" if share["n"] == 0 else f"{share['hits']}/{share['n']} = {format_interval(share)}"


def _table(rows: Sequence[Sequence[str]], alignment: str) -> str:
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join(
        "  ".join(f"{cell:{side}{width}}" for cell, side, width in zip(row, alignment, widths, strict=True)).rstrip()
        for row in rows
    )
