"""docs/performance.md: training's speed against a plain loop over torchvision's DataLoader, in one run."""

from dataclasses import fields

from omegaconf import DictConfig, OmegaConf

from train.command_line.configuration import read_settings
from train.command_line.entry_points import command_line
from train.command_line.outputs import writable_file
from train.device import choose_device, compiles, set_deterministic, set_threads
from train.networks import model_title
from train.report.tables import markdown, shown
from train.run_folder.logs import PHASES
from train.settings import ExperimentSettings
from train.studies.page import filled, machine, wrapped, write_section
from train.studies.targets import table_of
from train.studies.training_speed.contest import BenchmarkSettings, load, measure
from train.studies.training_speed.findings import ADVERSARIAL, BASELINE, PLAIN, REST, RUN, Findings, Spread, targets
from train.studies.training_speed.peak import PRECISIONS

SHORTENED = """A turn is an epoch shortened to {trained} images, and {validated} to validate on; the plain arm, the
baseline and the matrix products take turns in every round, so that a busy machine disturbs all alike. The seconds of a
whole epoch, {images} images and {validation} to validate on, are scaled up from the plain arm's training and
evaluation, for both arms; attack, input and output are whole, and as measured."""
WHOLE = """A turn is a whole epoch, {images} images and {validation} to validate on; one contestant comes after the
other."""
ON_GPU = " (TF32 as torch leaves it, `cudnn.benchmark` as for ours)"


def run(config: DictConfig) -> None:
    """Measure, and write the page's section. config: of an experiment, and BenchmarkSettings' keys."""
    own = [field.name for field in fields(BenchmarkSettings)]
    settings = read_settings(BenchmarkSettings, OmegaConf.masked_copy(config, own))
    out = writable_file(settings.out, "out")
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
    write_section(out, section(findings, facts))


def section(findings: Findings, facts: dict[str, str]) -> str:
    """In Markdown. facts: what the findings do not say: command, machine, network, data, compiled, workers."""
    work = findings.workload
    counts = {name: f"{getattr(work, name):,}" for name in ("trained", "validated", "images", "validation")}
    best = findings.peaks.items()
    text = filled(
        __file__,
        **facts,
        multiply_adds=findings.multiply_adds / 1e6,
        precision=findings.precision,
        batch_size=work.batch_size,
        renders=work.renders,
        rounds=len(findings.turns[PLAIN]) - 1,
        attacked=len(findings.turns[ADVERSARIAL]) - 1,
        attack_steps=shown(findings.attack_steps),
        turns=(SHORTENED if work.steps else WHOLE).format(**counts),
        on_gpu=ON_GPU if findings.device == "cuda" else "",
        peaks=" and ".join(f"{shown(rate / 1e12)} TFLOP/s in {name} ({size:,}²)" for name, (rate, size) in best),
        targets=table_of(targets(findings)),
        rates=_rates(findings),
        seconds=_seconds(findings),
    )
    return wrapped(text)


def _rates(findings: Findings) -> str:
    lines = [
        (
            who,
            findings.rate(name),
            findings.operations(name) / 1e12,
            *(f"{findings.share(name, precision):.0%}" for precision in PRECISIONS),
        )
        for who, name in (("ours", PLAIN), ("baseline", BASELINE))
    ]
    return markdown(["who", "images per second", "TFLOP/s", *(f"of the {name} peak" for name in PRECISIONS)], lines)


def _seconds(findings: Findings) -> str:
    arms = PLAIN, ADVERSARIAL
    seconds = {name: findings.seconds(name) for name in arms}
    once = {
        "operators, once a run": findings.operators,
        "warming up, once a run": findings.warm_up,
        f"{RUN} epochs": findings.whole_run,
    }
    lines = [
        *((phase.replace("_", " and "), *(seconds[name][phase] for name in arms)) for phase in (*PHASES, REST)),
        ("an epoch", *(Spread.of(findings.totals(name)) for name in arms)),
        *((what, *(of(name) for name in arms)) for what, of in once.items()),
    ]
    return markdown(["seconds", *arms], lines)
