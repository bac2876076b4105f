"""Training speed against a plain loop over torchvision's DataLoader, in one run: python scripts/benchmark_training.py

Writes docs/performance.md and a figure beside it. conf/benchmark_training.yaml has the settings.
"""

import sys
from dataclasses import fields

import hydra
from benchmarks.measure import machine
from benchmarks.plots import pyplot
from benchmarks.training.contest import BenchmarkSettings, load, measure
from benchmarks.training.page import draw, page
from omegaconf import DictConfig, OmegaConf

from train.cli import command_line, one_sentence_errors, with_suggestions
from train.device import choose_device, set_deterministic, set_threads
from train.graphs import compiles
from train.outputs import save_page, writable_file
from train.settings import ExperimentSettings, read_settings


@hydra.main(version_base="1.3", config_path="pkg://conf", config_name="benchmark_training")
@one_sentence_errors
def main(config: DictConfig) -> None:
    write_page(config)


def write_page(config: DictConfig) -> None:
    """Measure, print the page, and write it and its figure."""
    pyplot()  # a run without matplotlib would fail only at its end
    own = [field.name for field in fields(BenchmarkSettings)]
    settings = read_settings(BenchmarkSettings, OmegaConf.masked_copy(config, own))
    out = writable_file(settings.out, "out")
    figure = writable_file(out.with_suffix(".png"), "out")
    config = OmegaConf.masked_copy(config, [key for key in config if key not in own])
    read_settings(ExperimentSettings, config)
    device = choose_device(config.train.device)
    set_threads(config.train.threads)
    set_deterministic(config.train.deterministic)
    settings, description = settings.on(device), machine(device)
    findings = measure(settings, config, load(config), device)
    facts = {
        "command": command_line(sys.argv[1:]),
        "machine": description,
        "network": f"WideResNet-{config.model.depth}-{config.model.width} with dropout {config.model.dropout:g}",
        "data": f"`data={config.data.name}`" if config.data.path else "random pictures like CIFAR-100's",
        "compiled": "compiled" if compiles(config.train.compile, device) else "not compiled",
        "workers": settings.workers,
    }
    text = page(findings, facts, figure.name)
    save_page(out, text)
    draw(figure, findings)
    print(f"\n{text}\nwritten: {out} and {figure}")


if __name__ == "__main__":
    with_suggestions(main, "benchmark_training")
