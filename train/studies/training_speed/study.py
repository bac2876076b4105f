"""Training's speed against a plain loop over torchvision's DataLoader, in one run."""

from dataclasses import fields

from omegaconf import DictConfig, OmegaConf

from train.command_line.configuration import read_settings
from train.command_line.entry_points import command_line
from train.command_line.outputs import writable_file
from train.device import choose_device, compiles, set_deterministic, set_threads
from train.networks import model_title
from train.settings import ExperimentSettings
from train.studies.page import machine, write
from train.studies.training_speed.contest import BenchmarkSettings, load, measure
from train.studies.training_speed.page import draw, page


def run(config: DictConfig) -> None:
    """Measure, and write the page and its figure. config: of an experiment, and BenchmarkSettings' keys."""
    own = [field.name for field in fields(BenchmarkSettings)]
    settings = read_settings(BenchmarkSettings, OmegaConf.masked_copy(config, own))
    out = writable_file(settings.out, "out")
    figure = writable_file(out.with_suffix(".png"), "out")
    config = OmegaConf.masked_copy(config, [str(key) for key in config if key not in own])
    read_settings(ExperimentSettings, config)
    device = choose_device(config.train.device)
    set_threads(config.train.threads)
    set_deterministic(config.train.deterministic)
    settings, description = settings.on(device), machine(device)
    findings = measure(settings, config, load(config), device)
    facts = {
        "command": command_line(),
        "machine": description,
        "network": model_title(**config.model),
        "data": f"`data={config.data.name}`" if config.data.path else "random images like CIFAR-100's",
        "compiled": "compiled" if compiles(config.train.compile, device) else "not compiled",
        "workers": str(settings.workers),
    }
    write(out, page(findings, facts, figure.name))
    draw(figure, findings)
