"""Real photographs: find them in a folder, reduce them to the classifier's size, and score its answers."""

from train.photographs.figures import FIGURES, figure_title, find_figure
from train.photographs.folder import (
    Photograph,
    find_photographs,
    is_hidden,
    left_out,
    load_photographs,
    require_outside,
)
from train.photographs.scoring import SUMMARY, evaluate_photographs
from train.photographs.shares import share
from train.photographs.text import format_interval, format_summary

__all__ = [
    "FIGURES",
    "SUMMARY",
    "Photograph",
    "evaluate_photographs",
    "figure_title",
    "find_figure",
    "find_photographs",
    "format_interval",
    "format_summary",
    "is_hidden",
    "left_out",
    "load_photographs",
    "require_outside",
    "share",
]
