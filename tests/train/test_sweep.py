import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_module
from hydra.core.override_parser.overrides_parser import OverridesParser
from hypothesis import given
from hypothesis import strategies as st
from omegaconf import OmegaConf

from train import __main__ as command
from train import checkpoint, loop, sweep
from train.checkpoint import LAST, content_hash
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


# ---------------------------------------------------------------------------------------- names


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


OVERRIDES = st.dictionaries(
    st.sampled_from(["seed", "augment", "data.path", "scene.meshes"]),
    st.text(st.characters(codec="utf-8", exclude_characters="\n"), max_size=300),
)


@given(OVERRIDES, OVERRIDES)
def test_different_runs_have_different_names_that_file_systems_and_command_lines_take(first, second):
    names = [cell_name([f"{key}={value}" for key, value in overrides.items()]) for overrides in (first, second)]
    assert (names[0].lower() == names[1].lower()) == (first == second)
    for name in names:
        assert len(name.encode()) < 256 and not name.startswith((".", "-"))
        (override,) = OverridesParser.create().parse_overrides([f"run=runs/sweep/{name}"])
        assert override.value() == f"runs/sweep/{name}"


# ---------------------------------------------------------------------------------------- finished and unfinished runs


def test_a_second_call_skips_finished_runs_and_shows_them_again(run_sweep, cell, swept, capsys):
    cells = [cell(swept, f"seed={seed}") for seed in (0, 1)]

    def files():
        paths = [path for folder in cells for path in folder.rglob("*") if path.is_file() and path.name != LOCK]
        return {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in paths}

    before = files()
    assert run_sweep(swept, "seed=0,1") == 0
    assert files() == before
    printed = capsys.readouterr().out
    assert printed.splitlines()[-1] == f"report: 2 in {swept}"
    assert [line for line in printed.splitlines() if line.startswith("finished before")] == [
        f"finished before: {folder}" for folder in cells
    ]
    assert [row[:2] for row in rows(printed)] == [
        ["augment", "seed"], ["none", "0"], ["none", "1"], ["augment", "seeds"], ["none", "2"]
    ]  # fmt: skip


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_stops_the_sweep_and_a_second_call_ends_as_if_there_had_been_none(
    run_sweep, cell, swept, tmp_path, monkeypatch, capsys, number
):
    evaluate, calls = loop.evaluate, []
    handler = signal.getsignal(signal.SIGTERM)

    def interrupted(*arguments):
        calls.append(arguments)
        if len(calls) == 2:
            signal.raise_signal(number)
        return evaluate(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(loop, "evaluate", interrupted)
        assert run_sweep(tmp_path, "seed=0,1") == 128 + number
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
    run_sweep, cell, tmp_path, monkeypatch, capsys, caplog
):
    train = sweep.run

    def broken(settings, data, folder):
        if settings.train.learning_rate == 0.5:
            raise ZeroDivisionError("a mistake of the program")
        train(settings, data, folder)

    overrides = ["train.epochs=1", "train.learning_rate=-1,0.05,0.5"]
    wrong, right, unlucky = (
        cell(tmp_path, "train.epochs=1", f"train.learning_rate={r}") for r in ("-1", "0.05", "0.5")
    )
    reasons = {
        wrong: "train.learning_rate: learning_rate=-1.0 must be positive and at most 100000",
        unlucky: "ZeroDivisionError: a mistake of the program",
    }
    with monkeypatch.context() as patch:
        patch.setattr(sweep, "run", broken)
        assert run_sweep(tmp_path, *overrides) == 1
    failed = [f"{folder}: failed: {reason}" for folder, reason in reasons.items()]
    printed = capsys.readouterr().out
    assert "1 of 3 cells are finished\n" in printed and [row[0] for row in rows(printed)] == ["augment", "none"]
    assert printed.splitlines()[-4:-1:2] == failed
    assert [(folder / FAILURE).read_text() for folder in reasons] == [f"{reason}\n" for reason in reasons.values()]
    assert [record.message for record in caplog.records if record.exc_info] == [f"failed: {reasons[unlucky]}"]

    assert run_sweep(tmp_path, *overrides) == 1
    printed = capsys.readouterr().out
    assert f"finished before: {right}\n" in printed and "2 of 3 cells are finished\n" in printed
    assert failed[0] in printed and failed[1] not in printed and not (unlucky / FAILURE).exists()


def test_a_run_that_another_process_trains_is_left_alone(run_sweep, cell, tmp_path, capsys):
    folder = cell(tmp_path, "seed=3")
    with locked(folder):
        assert run_sweep(tmp_path, "seed=3") == 1
        assert format_sweep([folder]).endswith(f"{folder}: in training")
    assert f"in training elsewhere: {folder}\n" in capsys.readouterr().out
    assert [path.name for path in folder.iterdir()] == [LOCK]


def edited(swept: Path, cell, folder: Path, key: str, value: object) -> Path:
    """A copy of the sweep in `folder` whose first cell was run with another setting; the cell."""
    shutil.copytree(swept, folder)
    config = OmegaConf.load(cell(folder, "seed=0") / "config.yaml")
    OmegaConf.update(config, key, value, force_add=True)
    OmegaConf.save(config, cell(folder, "seed=0") / "config.yaml")
    return cell(folder, "seed=0")


@pytest.mark.parametrize(
    "key, value, finished",
    [("train.epochs", 7, True), ("scene.backgrounds", [0.5], False), ("train.removed_key", True, True)],
)
def test_a_run_with_other_settings_is_refused_before_any_is_trained(
    run_sweep, cell, swept, tmp_path, capsys, key, value, finished
):
    folder = edited(swept, cell, tmp_path / "edited", key, value)
    if not finished:
        (folder / "metrics.jsonl").unlink()
    assert run_sweep(tmp_path / "edited", "seed=2,0") == USER_ERROR
    printed = capsys.readouterr()
    assert printed.out == "" and printed.err.startswith(f"error: {folder} was trained with {key}={value}, not ")
    assert not cell(tmp_path / "edited", "seed=2").exists()


def test_another_version_of_torch_is_no_other_setting(run_sweep, cell, swept, tmp_path):
    folder = edited(swept, cell, tmp_path / "edited", "versions.torch", "2.6")
    config = (folder / "config.yaml").read_bytes()
    assert run_sweep(tmp_path / "edited", "seed=0,1") == 0
    assert (folder / "config.yaml").read_bytes() == config


# ---------------------------------------------------------------------------------------- launchers


def sweep_process(folder: Path, *overrides: str) -> subprocess.CompletedProcess:
    """`python -m train --multirun` with a small network in processes of its own."""
    with start_sweep(folder, *overrides) as process:
        out, errors = process.communicate()
    return subprocess.CompletedProcess(process.args, process.returncode, out, errors)


def start_sweep(folder: Path, *overrides: str) -> subprocess.Popen:
    environment = {name: value for name, value in os.environ.items() if name != "SUBMITIT_EXECUTOR"}
    return subprocess.Popen(
        [sys.executable, "-m", "train", "--multirun", *SMALL, "train.epochs=1", f"sweep={folder}", *overrides],
        cwd=folder.parent,
        env=environment | {"PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
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
    assert {path for path in folder.iterdir() if path.is_dir()} == {good, bad, folder / "report_files"}
    assert [row[0] for row in rows(done.stdout)] == ["augment", "none"]
    assert f"{bad}: failed: {(bad / FAILURE).read_text()}" in done.stdout
    assert f"#1 failed: {(bad / FAILURE).read_text()}" in done.stdout
    log = (good / "train.log").read_text().splitlines()
    assert [line.removeprefix("#0 ") for line in done.stdout.splitlines() if line.startswith("#0 ")] == log


@pytest.mark.slow
def test_submitits_executor_trains_runs_in_jobs(tiny_npz, cell, tmp_path):
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher")
    folder = tmp_path / "sweep"
    done = sweep_process(folder, f"data.path={tiny_npz}", "launcher=submitit_local")
    assert done.returncode == 0, done.stderr
    trained, reports = cell(folder, "train.epochs=1"), folder / "report_files"
    assert {path for path in folder.iterdir() if path.is_dir()} == {trained, folder / ".submitit", reports}
    assert [row[:2] for row in rows(done.stdout)] == [["augment", "seed"], ["none", "0"]]
    (log,) = (folder / ".submitit").glob("*/*_log.out")
    assert "epoch 1/1" in log.read_text() and "epoch 1/1" not in done.stdout


@pytest.mark.slow
def test_a_preempted_job_queues_itself_again_and_ends_with_the_same_bits(tiny_npz, cell, tmp_path):
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher")
    long = [f"data.path={tiny_npz}", "train.epochs=20"]
    undisturbed = sweep_process(tmp_path / "undisturbed", *long)
    assert undisturbed.returncode == 0, undisturbed.stderr
    folder = tmp_path / "preempted"
    with start_sweep(folder, *long, "launcher=submitit_local") as process:
        (log,) = wait_for(lambda: [file for file in folder.glob(".submitit/*/*.out") if "epoch 2/" in file.read_text()])
        (job,) = (int(path.parent.name) for path in Path("/proc").glob("[0-9]*/cmdline") if is_job(path, folder))
        os.kill(job, signal.SIGUSR2)  # as Slurm does where the job is preempted
        assert process.wait(300) == 0
    assert "Requeued job" in log.read_text() and "resumed" in log.read_text()
    one, other = (checkpoint.load(cell(sweep, *long) / LAST) for sweep in (tmp_path / "undisturbed", folder))
    assert one["epoch"] == other["epoch"] and content_hash(one["model"]) == content_hash(other["model"])


def wait_for(found, seconds=120):
    """The first result of `found()` that is true."""
    end = time.monotonic() + seconds
    while not (result := found()):
        assert time.monotonic() < end
        time.sleep(0.05)
    return result


def is_job(command_line: Path, folder: Path) -> bool:
    """Whether a process is a job of submitit's with logs in the folder."""
    try:
        words = command_line.read_bytes().decode(errors="replace").split("\0")
    except OSError:  # it has ended
        return False
    return "submitit.core._submit" in words and any(word.startswith(str(folder)) for word in words)
