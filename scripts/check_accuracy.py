"""Measure the renderer's largest errors and write them as docs/accuracy.md: python scripts/stress_renderer.py"""

import sys
from pathlib import Path

import hydra
import torch
from omegaconf import DictConfig
from stress.page import failures, measure, page
from stress.refusals import refusals

from train.cli import command_line, one_sentence_errors, with_suggestions


@hydra.main(version_base="1.3", config_path="pkg://conf", config_name="stress_renderer")
@one_sentence_errors
def main(config: DictConfig) -> None:
    torch.set_num_threads(1)
    tables = measure(config.degree, config.subdivisions, config.size, config.slivers)
    refused = list(refusals())
    out = Path(config.out)
    out.write_text(page(tables, refused, command_line(sys.argv[1:])))
    print(f"{out}: {sum(len(table.rows) for table in tables)} conditions and {len(refused)} refusals")
    if failed := failures(tables, refused):
        sys.exit("\n".join(failed))


if __name__ == "__main__":
    with_suggestions(main, "stress_renderer")
