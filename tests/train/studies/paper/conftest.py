import sys
from collections.abc import Callable

import pytest
import torch

from train.command_line.configuration import composed, read_settings
from train.studies.paper import study


@pytest.fixture
def reproduce(monkeypatch) -> Callable:
    """`python scripts/reproduce_paper.py` in this process, with a classifier in place of the one that is named."""

    def run(classifier, *overrides: str) -> None:
        monkeypatch.setattr(study, "load_classifier", lambda *_: classifier)
        monkeypatch.setattr(torch, "set_num_threads", lambda threads: None)
        monkeypatch.setattr(sys, "argv", ["scripts/reproduce_paper.py", *overrides])
        config = composed("reproduce_paper", overrides)
        study.run(read_settings(study.PaperSettings, config))

    return run
