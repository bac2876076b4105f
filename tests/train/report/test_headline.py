import io
from collections.abc import Sequence
from pathlib import Path

import pytest
import torch
from PIL import Image

from augment.service import AttackExamples
from train.photographs.shares import share
from train.report.headline import headline
from train.report.summary import RunSummary, summarize
from train.run_folder.attack_examples import write_attack_examples

AUC = {"value": 0.9, "low": 0.8, "high": 1.0}


def keep_specimens(folder: Path, epoch: int, before: list[float], after: list[float]) -> None:
    """Two gray renders of orange that are called apple or orange, with these probabilities in turn."""
    images, lights = torch.full((2, 2, 3, 8, 8), 0.5), torch.zeros(2, 2, 49, 3)
    answers = torch.tensor([before, after])[:, None].expand(2, 2, 2)
    (folder / "renders").mkdir(exist_ok=True)
    attack_examples = AttackExamples(*images, *lights, *answers, torch.ones(2, dtype=torch.int64))
    write_attack_examples(folder / "renders" / f"epoch_{epoch:03d}.safetensors", attack_examples, ["apple", "orange"])


@pytest.fixture
def arm(made_up_run, tmp_path):
    """The runs of an arm, a seed for each pair of hits and false alarms among ten."""

    def make(name: str, *counts: tuple[int, int], overrides: Sequence[str] = ()) -> list[RunSummary]:
        runs = []
        for seed, (hits, alarms) in enumerate(counts):
            scores = {"recall": share(hits, 10), "false_alarms": share(alarms, 10), "auc": AUC}
            folder, settings = tmp_path / f"{name}{seed}", [f"seed={seed}", "evaluate.photos=/data/a", *overrides]
            made_up_run(folder, name, {"photographs": scores}, *settings)
            runs.append(summarize(folder))
        return runs

    return make


def test_it_tells_the_answers_before_and_after_and_the_scores_of_every_arm(arm):
    arms = {"none": arm("none", (2, 0)), "random": arm("random", (5, 1)), "adversarial": arm("adversarial", (7, 2))}
    assert headline(arms, "photographs") is None
    keep_specimens(arms["adversarial"][0].folder, 1, [0.125, 0.875], [0.75, 0.25])
    keep_specimens(arms["adversarial"][0].folder, 2, [0.75, 0.25], [0.75, 0.25])  # wrong before, too
    shown = headline(arms, "photographs")
    assert shown.alt == (
        "Orange before and after its light changed, called orange 88%, then apple 75%; orange 88%, then apple 75%. "
        "Recall on photographs: none 0.20, random 0.50, adversarial 0.70. "
        "False alarms on photographs: none 0.00, random 0.10, adversarial 0.20. "
        "AUC on photographs: none 0.90, random 0.90, adversarial 0.90."
    )
    with Image.open(io.BytesIO(shown.data)) as image:
        assert image.width == 2 * shown.width and len(shown.data) < 2**18


def test_of_several_seeds_it_tells_the_mean(arm):
    arms = {"none": arm("none", (2, 0), (4, 0)), "adversarial": arm("adversarial", (7, 0))}
    keep_specimens(arms["none"][0].folder, 1, [0.125, 0.875], [0.75, 0.25])
    assert "Recall on photographs: none 0.30, adversarial 0.70." in headline(arms, "photographs").alt


def test_renders_are_not_called_photographs(arm):
    runs = arm("none", (2, 0), overrides=["+data.images=/data/a"])
    keep_specimens(runs[0].folder, 1, [0.125, 0.875], [0.75, 0.25])
    assert "AUC on held-out renders: none 0.90." in headline({"none": runs}, "photographs").alt


def test_without_scores_it_shows_what_fooled(arm):
    runs = arm("none", (2, 0))
    keep_specimens(runs[0].folder, 1, [0.125, 0.875], [0.75, 0.25])
    assert headline({"none": runs}, "other").alt.endswith("then apple 75%.")
