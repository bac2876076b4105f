"""The summary of an evaluation as text for the terminal."""

from typing import Any

from train.photographs.figures import RANKED, figure_title, find_figure
from train.report.tables import aligned

COUNTED = ("recall", "top5", "false_alarms")
NAMED = 10  # how many of the files that were left out


def format_summary(summary: dict[str, Any]) -> str:
    """The summary of `evaluate_photographs` as tables in Markdown, without a newline at the end."""
    label, n = summary["label"], summary["n"]
    pools = {"overall": summary, **summary["by_source"]}
    shares = [[name, *(_counted(pool[key]) for key in COUNTED)] for name, pool in pools.items()]
    ranked = [[name, *(format_interval(find_figure(pool, key)) for key in RANKED)] for name, pool in pools.items()]
    by_class = [[name, *_class_cells(figures)] for name, figures in summary["by_class"].items()]
    paragraphs = [
        f"{n['label']} images of {label}, {n['others']} of other things",
        aligned(["", "recall", "top-5", "false alarms"], shares),
        aligned(["", *(figure_title(name, label) for name in RANKED)], ranked),
        aligned(["class", "n", "recall", "top-5", f"called {label}", "most common wrong answers"], by_class),
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


def _class_cells(figures: dict[str, Any]) -> list[object]:
    shares = [figures[key] for key in ("recall", "top5", "called_label")]
    wrong = ", ".join(f"{answer} {count}" for answer, count in figures["most_common_wrong"].items())
    return [figures["n"], *("-" if share["n"] == 0 else f"{share['value']:.3f}" for share in shares), wrong]


def _counted(share: dict[str, Any]) -> str:
    return "-" if share["n"] == 0 else f"{share['hits']}/{share['n']} = {format_interval(share)}"
