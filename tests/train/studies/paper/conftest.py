import sys
from collections.abc import Callable

import pytest
import torch
from hydra import compose, initialize_config_module

from train.command_line.configuration import read_settings
from train.studies.paper import study


@pytest.fixture
def reproduce(monkeypatch) -> Callable:
    """`python scripts/reproduce_paper.py` in this process, with a classifier in place of the one that is named."""

    def run(classifier, *overrides: str) -> None:
        monkeypatch.setattr(study, "load_classifier", lambda *_: classifier)
        monkeypatch.setattr(torch, "set_num_threads", lambda threads: None)
        monkeypatch.setattr(sys, "argv", ["scripts/reproduce_paper.py", *overrides])
        with initialize_config_module("conf", version_base="1.3"):
            config = compose("reproduce_paper", list(overrides))
        study.run(read_settings(study.PaperSettings, config))

    return run
