"""Measure the renderer's largest errors and write them as docs/accuracy.md: python scripts/stress_renderer.py"""

import sys
from dataclasses import dataclass

import hydra
import torch
from omegaconf import DictConfig
from stress.page import failures, measure, page
from stress.refusals import refusals

from renderer.errors import require_range
from train.cli import command_line, one_sentence_errors, with_suggestions
from train.outputs import save_page, writable_file
from train.settings import read_settings


@dataclass
class Settings:
    """conf/stress_renderer.yaml."""

    out: str
    degree: int
    subdivisions: int
    size: int
    slivers: int

    def __post_init__(self):
        for name, least, most in [("degree", 1, 20), ("subdivisions", 0, 9), ("size", 1, 16384), ("slivers", 1, 10**4)]:
            require_range(name, getattr(self, name), least, most)


@hydra.main(version_base="1.3", config_path="pkg://conf", config_name="stress_renderer")
@one_sentence_errors
def main(config: DictConfig) -> None:
    config = read_settings(Settings, config)
    out = writable_file(config.out, "out")
    torch.set_num_threads(1)
    tables = measure(config.degree, config.subdivisions, config.size, config.slivers)
    refused = list(refusals())
    save_page(out, page(tables, refused, command_line(sys.argv[1:])))
    print(f"{out}: {sum(len(table.rows) for table in tables)} conditions and {len(refused)} refusals")
    if failed := failures(tables, refused):
        sys.exit("\n".join(failed))


if __name__ == "__main__":
    with_suggestions(main, "stress_renderer")
