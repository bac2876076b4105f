"""pnb-publish: a run's network as half-precision safetensors."""

from dataclasses import asdict
from pathlib import Path

from train.command_settings import PublishSettings
from train.commands.results import require_replaceable
from train.evaluation.scores import scoring
from train.evaluation.scores.predictions import Predictor
from train.networks import PYTHON
from train.report.summary import summarize
from train.runs.saved_networks import PUBLISHED, load_run, load_selected, publish
from train.settings import mapped, published
from train.system.user_errors import writable_folder


def publish_network(settings: PublishSettings) -> None:
    """Write a run's network, and print where.

    Raises:
        InputError: If there is no network, or nobody could use it.
    """
    out, given = writable_folder(settings.out, "out"), Path(settings.run)
    path, state = load_selected(given)
    own = [PUBLISHED] if path.resolve() == (out / PUBLISHED).resolve() else []  # it gets an operating point
    require_replaceable(out, "out", settings.overwrite, own)
    if path.suffix != Path(PUBLISHED).suffix:  # a run of pnb-train
        run = summarize(given)
        # Names of files in place of their paths, which are of this machine alone.
        state["settings"] = mapped(dict(run.settings), lambda text: Path(text).name if text[:1] == "/" else text)
        state["versions"] = dict(run.config.versions)
        photographs = {name: scores.to_published() for name, scores in run.photographs.items()}
        state["scores"] = {**run.scores, **photographs}
    if settings.calibrate or not str(state["architecture"].get("name")).startswith(PYTHON):  # its user runs that code
        network = load_run(path, model=settings.model)  # or InputError, since nobody could use it
    if settings.calibrate and settings.false_positive_rate:
        network.half().float()  # as it is published
        folder, rate = published(Path(settings.calibrate)), settings.false_positive_rate
        predictor = Predictor(network, network.classes, network.size)
        points = scoring.choose_operating_points(predictor, folder, settings.label, rate)
        state["operating_point"] = [asdict(point) for point in points]
        for point in points:
            print(f"{point.label}: threshold {point.threshold:.3f} for {scoring.describe_point(asdict(point))}")
    out.mkdir(parents=True, exist_ok=True)
    publish(out / PUBLISHED, state)
    print(f"published in {settings.out}")
