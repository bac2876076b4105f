"""Real photographs: find them in a folder, reduce them to the classifier's size, and score its answers."""

from train.photographs.folder import Photograph, find_photographs, left_out, load_photographs
from train.photographs.scoring import evaluate_photographs
from train.photographs.shares import share
from train.photographs.text import format_summary

__all__ = [
    "Photograph",
    "evaluate_photographs",
    "find_photographs",
    "format_summary",
    "left_out",
    "load_photographs",
    "share",
]
