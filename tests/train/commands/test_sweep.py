import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_module
from hydra.core.override_parser.overrides_parser import OverridesParser
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.train.helpers import modification_times, read_markdown
from train import __main__ as command
from train.__main__ import run_name
from train.cli import USER_ERROR, expand
from train.commands.experiment import format_sweep
from train.run_config import write_config
from train.run_folder import FAILURE, LAST, LOCK, locked, read_metrics
from train.training import loop
from train.training.run import Run

pytestmark = pytest.mark.usefixtures("no_report")
ROOT = Path(__file__).parents[3]
SMALL = [
    *("experiment=paper", "augment=none", "data=npz", "model.depth=10", "model.width=1"),
    *("train.epochs=2", "train.batch_size=16", "train.learning_rate=0.05"),
    *("train.precision=float32", "train.device=cpu", "photos=null"),
]


@pytest.fixture
def run_sweep(call, tiny_npz) -> Callable[..., int]:
    """Return a function that trains by a sweep in this process, and returns the exit status."""
    words = "train", "--multirun", *SMALL, f"data.path={tiny_npz}"
    return lambda folder, *overrides: call(*words, f"sweep={folder}", *overrides)


@pytest.fixture(scope="module")
def folder_of(tiny_npz) -> Callable[..., Path]:
    """Return a function that finds a run, which differs from others in the last override."""

    def find(parent: Path, *overrides: str) -> Path:
        override_of_key = {}
        for override in [*SMALL, f"data.path={tiny_npz}", *overrides]:
            key, _, _ = override.partition("=")
            override_of_key[key] = override  # The last value of a key counts.
        common_keys = [other for other in override_of_key if other != key]
        return parent / run_name([*override_of_key.values()], common_keys, str(parent))

    return find


@pytest.fixture
def swept(run_sweep, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("sweeps") / "swept"
    assert run_sweep(folder, "seed=0,1") == 0
    return folder


def require_same_weights(first: Path, second: Path) -> None:
    first_weights = torch.load(first / LAST, weights_only=True)["model"]
    second_weights = torch.load(second / LAST, weights_only=True)["model"]
    for name, value in first_weights.items():
        assert torch.equal(value, second_weights[name])


@pytest.mark.parametrize(
    ("overrides", "name"),
    [
        ([], "run"),
        (["seed=0", "augment=none", "model.depth=10"], "augment-none+seed-0"),
        (["launcher=joblib", "sweep=runs/x", "train.device=cpu", "seed=0"], "seed-0"),
    ],
)
def test_a_run_of_a_sweep_is_named_by_the_overrides_that_are_its_own(overrides, name):
    found, at, _ = run_name(overrides, ["model.depth"]).partition("@")
    assert at
    assert found == name


@pytest.mark.parametrize(
    ("key", "value"), [("network", "run:pretrained/none"), ("label", "sweet pepper")]
)
def test_the_runs_of_a_sweep_get_texts_as_they_are_typed(key, value):
    (words,) = expand(command.main.to_overrides([f"{key}={value}", "seed=0"]))
    assert command.main.compose(words, as_typed=False)[key] == value


def test_a_run_keeps_its_folder_when_a_sweep_gets_more_values(tmp_path):
    first = run_name(["augment=none", "seed=0"], ["augment"], str(tmp_path))
    (tmp_path / first).mkdir()
    assert run_name(["seed=0", "augment=none"], [], str(tmp_path)) == first


PARSER = OverridesParser.create()


@settings(max_examples=settings.default.max_examples // 8)  # Hydra's parser is slow.
@given(st.dictionaries(st.sampled_from(["seed", "data.path", "meshes"]), st.text(max_size=90)))
def test_file_systems_and_command_lines_take_the_name_of_a_run(values):
    name = run_name([f"{key}={value}" for key, value in values.items()], ["data.path"])
    assert len(name.encode()) < 256
    (override,) = PARSER.parse_overrides([f"out=runs/sweep/{name}"])
    assert override.value() == f"runs/sweep/{name}"


@pytest.mark.slow
def test_a_second_call_trains_nothing_and_shows_finished_runs(run_sweep, folder_of, swept, capsys):
    folders = [folder_of(swept, f"seed={seed}") for seed in (0, 1)]
    before = [modification_times(folder) for folder in folders]
    assert run_sweep(swept, "seed=0,1") == 0
    assert [modification_times(folder) for folder in folders] == before
    (table,) = read_markdown(capsys.readouterr().out).values()
    assert [row[:2] for row in table] == [["network", "runs"], ["none", "2"]]


@pytest.mark.slow
def test_a_signal_stops_the_sweep_and_a_second_call_ends_as_if_there_had_been_none(
    run_sweep, folder_of, swept, tmp_path, monkeypatch, capsys
):
    evaluate = loop.evaluate
    calls = []

    def interrupted(*arguments):
        calls.append(arguments)
        if len(calls) == 2:
            signal.raise_signal(signal.SIGTERM)
        return evaluate(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(loop, "evaluate", interrupted)
        assert run_sweep(tmp_path, "seed=0,1") == 128 + signal.SIGTERM
    first = folder_of(tmp_path, "seed=0")
    second = folder_of(tmp_path, "seed=1")
    assert (first / LAST).exists()
    assert not second.exists()
    printed = capsys.readouterr().out
    assert "0 of 2 runs are finished\n" in printed
    assert f"{first}: interrupted\n" in printed
    assert f"{second}: not begun\n" in printed

    assert run_sweep(tmp_path, "seed=0,1") == 0
    for folder in (first, second):
        require_same_weights(folder, swept / folder.name)
        assert len(read_metrics(folder)) == 3


@pytest.mark.slow
def test_a_failed_run_is_reported_with_its_reason_and_tried_again_and_stops_no_other(
    run_sweep, folder_of, tmp_path, monkeypatch, capsys
):
    train = Run.train

    def broken(run):
        if run.settings.train.learning_rate == 0.5:
            raise ZeroDivisionError("a mistake of the program")
        train(run)

    overrides = ["train.epochs=1", "train.learning_rate=0.05,0.5"]
    unlucky = folder_of(tmp_path, "train.epochs=1", "train.learning_rate=0.5")
    with monkeypatch.context() as patch:
        patch.setattr(Run, "train", broken)
        assert run_sweep(tmp_path, *overrides) == 1
    printed = capsys.readouterr().out
    assert "1 of 2 runs are finished\n" in printed
    failure = (unlucky / FAILURE).read_text()
    assert "ZeroDivisionError" in failure
    assert f"{unlucky}: failed: {failure}" in printed

    assert run_sweep(tmp_path, *overrides) == 0
    assert "2 of 2 runs are finished\n" in capsys.readouterr().out
    assert not (unlucky / FAILURE).exists()


@pytest.mark.parametrize(
    ("override", "start"),
    [
        ("train.learning_rate=0.05,-1", "train.learning_rate=-1.0"),
        ("compare=[none]", "compare=['none'] makes no sweep"),
        ("photos=null,missing", "photos: missing is not a folder"),
    ],
)
def test_a_wrong_setting_fails_before_any_run(run_sweep, tmp_path, capsys, override, start):
    assert run_sweep(tmp_path / "sweep", override) == USER_ERROR
    printed = capsys.readouterr()
    assert printed.err.startswith(f"error: {start}")
    assert printed.err.count("error:") == 1
    assert not [*(tmp_path / "sweep").rglob("*.*")]


def test_a_run_that_another_process_trains_is_left_alone(run_sweep, folder_of, tmp_path):
    folder = folder_of(tmp_path, "seed=3")
    with locked(folder):
        assert run_sweep(tmp_path, "seed=3") == 1
        assert f"{folder}: in training\n" in format_sweep([folder])
    assert [path.name for path in folder.iterdir()] == [LOCK]


def test_a_run_of_other_settings_stops_the_sweep(run_sweep, folder_of, tiny_npz, tmp_path, capsys):
    folder = folder_of(tmp_path, "seed=0")
    overrides = [*SMALL, f"data.path={tiny_npz}", "seed=0", "train.epochs=7"]
    write_config(folder, command.main.read(overrides))
    (folder / "metrics.jsonl").write_text('{"epoch": 1}\n{"test/accuracy": 0.5}\n')
    assert run_sweep(tmp_path, "seed=2,0") == USER_ERROR
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.startswith(f"error: {folder} was made with train.epochs=7, not 2")
    assert not folder_of(tmp_path, "seed=2").exists()


def test_the_settings_of_the_launcher_slurm_are_accepted_by_its_plugin():
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher")
    with initialize_config_module("conf", version_base="1.3"):
        config = compose("train", ["launcher=slurm"], return_hydra_config=True)
    assert config.hydra.launcher._target_.startswith("hydra_plugins.hydra_submitit_launcher.")


def start_sweep(folder: Path, *overrides: str) -> subprocess.Popen:
    """Start a sweep of a small network in processes of its own, which print to output.txt."""
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    environment.pop("SUBMITIT_EXECUTOR", None)
    arguments = ["-m", "train", "-v", "--multirun", *SMALL, f"sweep={folder}", *overrides]
    with open(folder.parent / "output.txt", "w") as output:
        command = [sys.executable, *arguments]
        options = {"cwd": folder.parent, "env": environment, "stdout": output, "stderr": output}
        return subprocess.Popen(command, **options)


@pytest.mark.slow
def test_a_preempted_job_of_submitit_queues_itself_again_and_ends_with_the_same_weights(
    run_sweep, folder_of, tiny_npz, tmp_path
):
    """Send the signal, as Slurm does, to the process that submitit's controller started."""
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher")
    epochs = "train.epochs=20"
    data = f"data.path={tiny_npz}"
    process = start_sweep(tmp_path / "jobs", data, epochs, "launcher=submitit_local")
    log = tmp_path / "none"
    while not (log.is_file() and "epoch 2/" in log.read_text()):
        assert process.poll() is None
        time.sleep(0.05)
        log = next(tmp_path.glob("jobs/.submitit/*/*_log.out"), log)
    controller, _, _ = log.name.partition("_")
    child = Path(f"/proc/{controller}/task/{controller}/children").read_text()
    os.kill(int(child), signal.SIGUSR2)
    assert process.wait(300) == 0
    assert "Requeued job" in log.read_text()
    assert "resumed" in log.read_text()

    assert run_sweep(tmp_path / "undisturbed", epochs) == 0
    folders = (folder_of(tmp_path / name, epochs) for name in ("jobs", "undisturbed"))
    require_same_weights(*folders)
