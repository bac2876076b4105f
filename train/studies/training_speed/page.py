"""The page that a run leaves in docs/, and its figure."""

from pathlib import Path

import torch

from train.report.tables import markdown, shown
from train.run_folder.logs import PHASES
from train.studies.figures import pyplot, save
from train.studies.page import filled, joined
from train.studies.targets import table_of
from train.studies.training_speed.findings import ADVERSARIAL, BASELINE, PLAIN, REST, RUN, Findings, Spread, targets
from train.studies.training_speed.peak import PRECISIONS

SHORTENED = """A turn is an epoch shortened to {trained} images, and {validated} to validate on; the plain arm,
  the baseline and the matrix products take turns in every round, so that a busy machine disturbs all alike. The seconds
  of a whole epoch, {images} images and {validation} to validate on, are scaled up from the plain arm's training and
  evaluation, for both arms; attack, input and output are whole, and as measured."""
WHOLE = """A turn is a whole epoch, {images} images and {validation} to validate on; one contestant comes after the
  other."""
ON_GPU = (
    " (TF32 is {convolutions} in convolutions and {products} in matrix products, as torch leaves it; "
    "`cudnn.benchmark` is {trial}, as for ours)"
)


def page(findings: Findings, facts: dict[str, str], figure: str) -> str:
    """The whole page, in Markdown. facts: what the findings do not say: command, machine, network, data, workers."""
    sections = [
        _header(findings, facts),
        "## Targets",
        table_of(targets(findings)),
        "## Images per second",
        _rates(findings),
        _peaks(findings),
        "## Seconds per epoch",
        _seconds(findings),
        f"![Seconds per epoch by phase]({figure})",
    ]
    return joined(sections)


def draw(path: Path, findings: Findings) -> None:
    """A bar for each arm and for the baseline's training, by phase."""
    figure, ax = pyplot().subplots(figsize=(9, 2.6), layout="tight")
    names = [BASELINE, ADVERSARIAL, PLAIN]
    bars = {name: {phase: spread.median for phase, spread in findings.seconds(name).items()} for name in names[1:]}
    bars[BASELINE] = {"training": findings.workload.images / findings.rate(BASELINE).median}
    left = [0.0] * len(names)
    for phase in (*PHASES, REST):
        widths = [bars[name].get(phase, 0.0) for name in names]
        ax.barh(names, widths, left=left, label=_words(phase))
        left = [start + width for start, width in zip(left, widths, strict=True)]
    ax.set_xlabel("seconds per epoch")
    ax.legend(fontsize=8, loc="upper left", bbox_to_anchor=(1, 1))
    save(figure, path, dpi=100)


def _header(findings: Findings, facts: dict[str, str]) -> str:
    work = findings.workload
    counts = {name: f"{getattr(work, name):,}" for name in ("trained", "validated", "images", "validation")}
    return filled(
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
        on_gpu=_on_gpu() if findings.device == "cuda" else "",
    )


def _on_gpu() -> str:
    flags = {
        "convolutions": torch.backends.cudnn.allow_tf32,
        "products": torch.backends.cuda.matmul.allow_tf32,
        "trial": torch.backends.cudnn.benchmark,
    }
    return ON_GPU.format(**{name: "on" if flag else "off" for name, flag in flags.items()})


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


def _peaks(findings: Findings) -> str:
    lines = [(name, rate / 1e12, f"{size:,}²") for name, (rate, size) in findings.peaks.items()]
    return markdown(["peak", "TFLOP/s", "matrices"], lines)


def _seconds(findings: Findings) -> str:
    arms = PLAIN, ADVERSARIAL
    seconds = {name: findings.seconds(name) for name in arms}
    once = {
        "operators, once a run": findings.operators,
        "warming up, once a run": findings.warm_up,
        f"{RUN} epochs": findings.whole_run,
    }
    lines = [
        *((_words(phase), *(seconds[name][phase] for name in arms)) for phase in (*PHASES, REST)),
        ("an epoch", *(Spread.of(findings.totals(name)) for name in arms)),
        *((what, *(of(name) for name in arms)) for what, of in once.items()),
    ]
    return markdown(["seconds", *arms], lines)


def _words(phase: str) -> str:
    return phase.replace("_", " and ")
