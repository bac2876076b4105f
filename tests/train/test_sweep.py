import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_module
from hydra.core.override_parser.overrides_parser import OverridesParser
from hypothesis import given
from hypothesis import strategies as st
from omegaconf import OmegaConf

from train import __main__ as command
from train import loop, sweep
from train.checkpoint import LAST
from train.run_folder import FAILURE, LOCK, locked, read_metrics
from train.sweep import cell_name, format_sweep

ROOT = Path(__file__).parents[2]
USER_ERROR = 2
SMALL = [
    "augment=none", "data=npz", "model.depth=10", "model.width=1", "train.epochs=2", "train.batch_size=16",
    "train.learning_rate=0.05", "train.precision=float32", "train.device=cpu", "evaluate.photos=null",
]  # fmt: skip


@pytest.fixture(autouse=True)
def no_report(monkeypatch) -> None:
    monkeypatch.setattr(sweep, "report_of", lambda folders, out: f"report: {len(folders)} in {out}")


@pytest.fixture(scope="module")
def run_sweep(tiny_npz):
    """`python -m train --multirun` with a small network in this process, without its logs; its exit status."""

    def run(folder: Path, *overrides: str) -> int | None:
        logs = ["hydra/job_logging=none", "hydra/hydra_logging=none"]
        arguments = ["--multirun", *SMALL, f"data.path={tiny_npz}", f"sweep={folder}", *logs, *overrides]
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(sys, "argv", ["train", *arguments])
            try:
                command.start()
            except SystemExit as stop:
                return stop.code
        return 0

    return run


@pytest.fixture(scope="module")
def cell(tiny_npz):
    """The folder of a cell of `run_sweep`, by its further overrides; of a key's values the last counts."""

    def find(folder: Path, *overrides: str) -> Path:
        last = {override.partition("=")[0]: override for override in [*SMALL, f"data.path={tiny_npz}", *overrides]}
        return folder / cell_name([*last.values()])

    return find


@pytest.fixture(scope="module")
def swept(run_sweep, tmp_path_factory) -> Path:
    """A finished sweep over two seeds."""
    folder = tmp_path_factory.mktemp("sweeps") / "swept"
    assert run_sweep(folder, "seed=0,1") == 0
    return folder


def rows(text: str) -> list[list[str]]:
    """The cells of the Markdown tables in it, without their rules."""
    lines = [line for line in text.splitlines() if line.startswith("|") and not line.startswith("| --")]
    return [[part.strip() for part in line.strip("|").split("|")] for line in lines]


def weights(path: Path) -> dict[str, torch.Tensor]:
    return torch.load(path, weights_only=True)["model"]


@pytest.mark.parametrize(
    "overrides, name",
    [
        ([], "defaults"),
        (["seed=0", "augment=none"], "augment-none+seed-0"),
        (["launcher=joblib", "sweep=runs/x", "train.device=cpu", "seed=0", "train.resume=true"], "seed-0"),
        (["train.learning_rate=1e-3", "seed=-1"], "seed--1+train.learning_rate-1e-3"),
        (["data.path=/data/cifar100.npz"], "data.path-_data_cifar100.npz@"),
        (["scene.meshes=[a.glb,{mesh:b.glb,albedo_scale:2}]"], "scene.meshes-sh_b.glb_albedo_scale_2_@"),
        (["label=Orange"], "label-Orange@"),
    ],
)
def test_a_run_of_a_sweep_is_named_by_its_overrides(overrides, name):
    assert cell_name(overrides).startswith(name) and ("@" in name or cell_name(overrides) == name)


VALUES = st.text(st.characters(codec="utf-8", exclude_characters="\n"), max_size=300)
CELLS = st.dictionaries(st.sampled_from(["seed", "augment", "data.path", "scene.meshes"]), VALUES)


@given(CELLS, CELLS)
def test_different_runs_have_different_names_that_file_systems_and_command_lines_take(first, second):
    names = [cell_name([f"{key}={value}" for key, value in cell.items()]) for cell in (first, second)]
    assert (names[0].lower() == names[1].lower()) == (first == second)
    for name in names:
        assert len(name.encode()) < 256 and not name.startswith((".", "-"))
        (override,) = OverridesParser.create().parse_overrides([f"run=runs/sweep/{name}"])
        assert override.value() == f"runs/sweep/{name}"


def test_a_second_call_trains_nothing_again_and_shows_the_finished_runs(run_sweep, cell, swept, capsys):
    cells = [cell(swept, f"seed={seed}") for seed in (0, 1)]

    def files():
        paths = [path for folder in cells for path in folder.rglob("*") if path.is_file() and path.name != LOCK]
        return {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in paths}

    before = files()
    assert run_sweep(swept, "seed=0,1") == 0
    assert files() == before
    printed = capsys.readouterr().out
    assert all(f"finished before: {folder}\n" in printed for folder in cells)
    assert [row[:2] for row in rows(printed)] == [
        ["augment", "seed"], ["none", "0"], ["none", "1"], ["augment", "seeds"], ["none", "2"]
    ]  # fmt: skip


def test_a_signal_stops_the_sweep_and_a_second_call_ends_as_if_there_had_been_none(
    run_sweep, cell, swept, tmp_path, monkeypatch, capsys
):
    evaluate, calls = loop.evaluate, []
    handler = signal.getsignal(signal.SIGTERM)

    def interrupted(*arguments):
        calls.append(arguments)
        if len(calls) == 2:
            signal.raise_signal(signal.SIGTERM)
        return evaluate(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(loop, "evaluate", interrupted)
        assert run_sweep(tmp_path, "seed=0,1") == 128 + signal.SIGTERM
    assert signal.getsignal(signal.SIGTERM) == handler
    first, second = (cell(tmp_path, f"seed={seed}") for seed in (0, 1))
    assert (first / LAST).exists() and not second.exists()
    assert capsys.readouterr().out.splitlines()[-5::2] == [
        "0 of 2 cells are finished", f"{first}: interrupted", f"{second}: not begun"
    ]  # fmt: skip
    assert run_sweep(tmp_path, "seed=0,1") == 0
    for seed in (0, 1):
        found, expected = (weights(cell(folder, f"seed={seed}") / LAST) for folder in (tmp_path, swept))
        assert all(torch.equal(found[name], expected[name]) for name in expected)
        assert len(read_metrics(cell(tmp_path, f"seed={seed}"))) == 3


def test_a_failed_run_is_reported_with_its_reason_and_tried_again_and_stops_no_other(
    run_sweep, cell, tmp_path, monkeypatch, capsys
):
    train = sweep.run

    def broken(settings, data, folder):
        if settings.train.learning_rate == 0.5:
            raise ZeroDivisionError("a mistake of the program")
        train(settings, data, folder)

    overrides = ["train.epochs=1", "train.learning_rate=-1,0.05,0.5"]
    wrong, right, unlucky = (
        cell(tmp_path, "train.epochs=1", f"train.learning_rate={rate}") for rate in ("-1", "0.05", "0.5")
    )
    with monkeypatch.context() as patch:
        patch.setattr(sweep, "run", broken)
        assert run_sweep(tmp_path, *overrides) == 1
    printed = capsys.readouterr().out
    assert "1 of 3 cells are finished\n" in printed
    for folder, reason in [(wrong, "learning_rate=-1.0 must be positive"), (unlucky, "ZeroDivisionError: a mistake")]:
        assert f"{folder}: failed: {(folder / FAILURE).read_text()}" in printed and reason in printed

    assert run_sweep(tmp_path, *overrides) == 1
    printed = capsys.readouterr().out
    assert f"finished before: {right}\n" in printed and "2 of 3 cells are finished\n" in printed
    assert f"{wrong}: failed: " in printed and not (unlucky / FAILURE).exists()


def test_a_run_that_another_process_trains_is_left_alone(run_sweep, cell, tmp_path, capsys):
    folder = cell(tmp_path, "seed=3")
    with locked(folder):
        assert run_sweep(tmp_path, "seed=3") == 1
        assert format_sweep([folder]).endswith(f"{folder}: in training")
    assert f"in training elsewhere: {folder}\n" in capsys.readouterr().out
    assert [path.name for path in folder.iterdir()] == [LOCK]


@pytest.fixture
def edited(cell, swept, tmp_path):
    """Copies the finished sweep, changes a setting of its first cell, and gives the cell's folder."""

    def edit(key: str, value: object) -> Path:
        folder = cell(shutil.copytree(swept, tmp_path / "edited"), "seed=0")
        config = OmegaConf.load(folder / "config.yaml")
        OmegaConf.update(config, key, value, force_add=True)
        OmegaConf.save(config, folder / "config.yaml")
        return folder

    return edit


@pytest.mark.parametrize("finished", [True, False])
@pytest.mark.parametrize("key, value", [("train.epochs", 7), ("train.of_old", True)])
def test_a_run_with_other_settings_is_refused_before_any_is_trained(
    run_sweep, cell, edited, capsys, key, value, finished
):
    folder = edited(key, value)
    if not finished:
        (folder / "metrics.jsonl").unlink()
    assert run_sweep(folder.parent, "seed=2,0") == USER_ERROR
    printed = capsys.readouterr()
    assert printed.out == "" and printed.err.startswith(f"error: {folder} was trained with {key}={value}, not ")
    assert not cell(folder.parent, "seed=2").exists()


def sweep_process(folder: Path, *overrides: str) -> subprocess.CompletedProcess:
    """`python -m train --multirun` with a small network in processes of its own."""
    environment = {name: value for name, value in os.environ.items() if name != "SUBMITIT_EXECUTOR"}
    return subprocess.run(
        [sys.executable, "-m", "train", "--multirun", *SMALL, "train.epochs=1", f"sweep={folder}", *overrides],
        cwd=folder.parent,
        env=environment | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )


@pytest.mark.parametrize(
    "launcher, name", [("joblib", "JoblibLauncher"), ("slurm", "SlurmLauncher"), ("submitit_local", "LocalLauncher")]
)
def test_the_settings_of_every_launcher_are_accepted_by_its_plugin(launcher, name):
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher")
    with initialize_config_module("conf", version_base="1.3"):
        config = compose("train", [f"launcher={launcher}"], return_hydra_config=True)
    assert config.hydra.launcher._target_.endswith(f".{name}")


@pytest.mark.slow
def test_joblib_trains_runs_in_parallel_processes(tiny_npz, cell, tmp_path):
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    folder = tmp_path / "sweep"
    overrides = [f"data.path={tiny_npz}", "train.learning_rate=0.05,-1", "launcher=joblib", "hydra.launcher.n_jobs=2"]
    done = sweep_process(folder, *overrides)
    assert done.returncode == 1 and "Traceback" not in done.stderr
    good, bad = (cell(folder, "train.epochs=1", f"train.learning_rate={rate}") for rate in ("0.05", "-1"))
    assert [row[0] for row in rows(done.stdout)] == ["augment", "none"]
    assert f"{bad}: failed: {(bad / FAILURE).read_text()}" in done.stdout
    log = (good / "train.log").read_text().splitlines()
    assert [line.removeprefix("#0 ") for line in done.stdout.splitlines() if line.startswith("#0 ")] == log


@pytest.mark.slow
def test_submitits_executor_trains_runs_in_jobs(tiny_npz, cell, tmp_path):
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher")
    folder = tmp_path / "sweep"
    done = sweep_process(folder, f"data.path={tiny_npz}", "launcher=submitit_local")
    assert done.returncode == 0, done.stderr
    assert cell(folder, "train.epochs=1").is_dir()
    assert [row[:2] for row in rows(done.stdout)] == [["augment", "seed"], ["none", "0"]]
    (log,) = (folder / ".submitit").glob("*/*_log.out")
    assert "epoch 1/1" in log.read_text() and "epoch 1/1" not in done.stdout
