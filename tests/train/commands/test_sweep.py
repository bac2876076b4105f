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

from tests.train.helpers import read_markdown
from train import __main__ as command
from train.commands import sweep
from train.commands.sweep import format_sweep
from train.runs.checkpoint import LAST
from train.runs.run_lock import FAILURE, LOCK, locked
from train.runs.run_log import read_metrics
from train.runs.run_names import run_name
from train.training import loop

ROOT = Path(__file__).parents[3]
USER_ERROR = 2
SMALL = [
    "experiment=paper",
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
        arguments = ["--multirun", *SMALL, f"data.path={tiny_npz}", f"sweep={folder}", *overrides]
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(sys, "argv", ["train", *arguments])
            try:
                command.main()
            except SystemExit as stop:
                return stop.code
        return 0

    return run


@pytest.fixture(scope="module")
def folder_of(tiny_npz):
    """The folder of a run of `run_sweep`, by its further overrides; of a key's values the last counts, and the runs
    differ in the last key."""

    def find(parent: Path, *overrides: str) -> Path:
        last = {override.partition("=")[0]: override for override in [*SMALL, f"data.path={tiny_npz}", *overrides]}
        return parent / run_name([*last.values()], last.keys() - {overrides[-1].partition("=")[0]}, str(parent))

    return find


@pytest.fixture(scope="module")
def swept(run_sweep, tmp_path_factory) -> Path:
    """A finished sweep over two seeds."""
    folder = tmp_path_factory.mktemp("sweeps") / "swept"
    assert run_sweep(folder, "seed=0,1") == 0
    return folder


def require_same_weights(*folders: Path) -> None:
    first, second = (torch.load(folder / LAST, weights_only=True)["model"] for folder in folders)
    assert all(torch.equal(first[name], second[name]) for name in first)


@pytest.mark.parametrize(
    "overrides, name",
    [
        ([], "run@"),
        (["seed=0", "augment=none", "model.depth=10"], "augment-none+seed-0@"),
        (["launcher=joblib", "sweep=runs/x", "train.device=cpu", "seed=0", "train.resume=true"], "seed-0@"),
        (["train.learning_rate=1e-3", "seed=-1"], "seed--1+train.learning_rate-1e-3@"),
        (["scene.meshes=[a.glb,{mesh:b.glb,albedo_scale:2}]"], "scene.meshes-_a.glb_mesh_b.glb_albedo_scale_2_@"),
    ],
)
def test_a_run_of_a_sweep_is_named_by_the_overrides_that_are_its_own(overrides, name):
    assert run_name(overrides, ["model.depth"]).partition("@")[0] == name[:-1]


def test_a_run_keeps_its_folder_when_a_sweep_gets_more_values(tmp_path):
    first = run_name(["augment=none", "seed=0"], ["augment"], str(tmp_path))
    (tmp_path / first).mkdir()
    assert run_name(["seed=0", "augment=none"], [], str(tmp_path)) == first


VALUES = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\n"), max_size=300)
RUNS = st.dictionaries(st.sampled_from(["seed", "augment", "data.path", "scene.meshes"]), VALUES)


@given(RUNS, RUNS)
def test_different_runs_have_different_names_that_file_systems_and_command_lines_take(first, second):
    names = [run_name([f"{key}={value}" for key, value in run.items()], ["data.path"]) for run in (first, second)]
    assert (names[0].lower() == names[1].lower()) == (first == second)
    for name in names:
        assert len(name.encode()) < 256 and not name.startswith((".", "-"))
        (override,) = OverridesParser.create().parse_overrides([f"run=runs/sweep/{name}"])
        assert override.value() == f"runs/sweep/{name}"


def test_a_second_call_trains_nothing_again_and_shows_the_finished_runs(
    run_sweep, folder_of, swept, capsys, read_markdown
):
    folders = [folder_of(swept, f"seed={seed}") for seed in (0, 1)]

    def files():
        paths = [path for folder in folders for path in folder.rglob("*") if path.is_file() and path.name != LOCK]
        return {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in paths}

    before = files()
    assert run_sweep(swept, "seed=0,1") == 0
    assert files() == before
    printed = capsys.readouterr().out
    assert all(f"finished before: {folder}\n" in printed for folder in folders)
    (table,) = read_markdown(printed).values()
    assert [row[:2] for row in table] == [["network", "seed"], ["none", "0"], ["none", "1"], ["none", "2 seeds"]]


def test_a_signal_stops_the_sweep_and_a_second_call_ends_as_if_there_had_been_none(
    run_sweep, folder_of, swept, tmp_path, monkeypatch, capsys
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
    first, second = (folder_of(tmp_path, f"seed={seed}") for seed in (0, 1))
    assert (first / LAST).exists() and not second.exists()
    assert capsys.readouterr().out.splitlines()[-7:-1:2] == [
        "0 of 2 runs are finished", f"{first}: interrupted", f"{second}: not begun"
    ]  # fmt: skip
    assert run_sweep(tmp_path, "seed=0,1") == 0
    for folder in (first, second):
        require_same_weights(folder, swept / folder.name)
        assert len(read_metrics(folder)) == 3


def test_a_failed_run_is_reported_with_its_reason_and_tried_again_and_stops_no_other(
    run_sweep, folder_of, tmp_path, monkeypatch, capsys
):
    fit = sweep.Run.fit

    def broken(run):
        if run.settings.train.learning_rate == 0.5:
            raise ZeroDivisionError("a mistake of the program")
        fit(run)

    rates = ("-1", "0.05", "0.5")
    overrides = ["train.epochs=1", f"train.learning_rate={','.join(rates)}"]
    wrong, right, unlucky = (folder_of(tmp_path, overrides[0], f"train.learning_rate={rate}") for rate in rates)
    with monkeypatch.context() as patch:
        patch.setattr(sweep.Run, "fit", broken)
        assert run_sweep(tmp_path, *overrides) == 1
    printed = capsys.readouterr().out
    assert "1 of 3 runs are finished\n" in printed
    reasons = [(wrong, "train.learning_rate=-1.0 must be above 0"), (unlucky, "ZeroDivisionError: a mistake")]
    for folder, reason in reasons:
        assert f"{folder}: failed: {(folder / FAILURE).read_text()}" in printed and reason in printed

    assert run_sweep(tmp_path, *overrides) == 1
    printed = capsys.readouterr().out
    assert f"finished before: {right}\n" in printed and "2 of 3 runs are finished\n" in printed
    assert f"{wrong}: failed: " in printed and not (unlucky / FAILURE).exists()


def test_a_run_that_another_process_trains_is_left_alone(run_sweep, folder_of, tmp_path, capsys):
    folder = folder_of(tmp_path, "seed=3")
    with locked(folder):
        assert run_sweep(tmp_path, "seed=3") == 1
        assert f"{folder}: in training\n" in format_sweep([folder])
    assert f"in training elsewhere: {folder}\n" in capsys.readouterr().out
    assert [path.name for path in folder.iterdir()] == [LOCK]


@pytest.mark.parametrize("finished", [True, False])
def test_a_run_with_other_settings_is_refused_before_any_is_trained(
    run_sweep, folder_of, swept, tmp_path, capsys, finished
):
    folder = folder_of(shutil.copytree(swept, tmp_path / "edited"), "seed=0")
    config = (folder / "config.yaml").read_text()
    (folder / "config.yaml").write_text(config.replace("  epochs: 2\n", "  epochs: 7\n"))
    if not finished:
        (folder / "metrics.jsonl").unlink()
    assert run_sweep(folder.parent, "seed=2,0") == USER_ERROR
    printed = capsys.readouterr()
    assert printed.out == "" and printed.err.startswith(f"error: {folder} was made with train.epochs=7, not 2")
    assert not folder_of(folder.parent, "seed=2").exists()


@pytest.mark.parametrize(
    "launcher, plugin", [("joblib", "joblib"), ("slurm", "submitit"), ("submitit_local", "submitit")]
)
def test_the_settings_of_every_launcher_are_accepted_by_its_plugin(launcher, plugin):
    pytest.importorskip(f"hydra_plugins.hydra_{plugin}_launcher")
    with initialize_config_module("conf", version_base="1.3"):
        config = compose("train", [f"launcher={launcher}"], return_hydra_config=True)
    assert config.hydra.launcher._target_.startswith(f"hydra_plugins.hydra_{plugin}_launcher.")


def sweep_process(folder: Path, *overrides: str) -> subprocess.Popen:
    """`python -m train --multirun` with a small network in processes of its own; it prints to output.txt."""
    environment = {name: value for name, value in os.environ.items() if name != "SUBMITIT_EXECUTOR"}
    command = [sys.executable, "-m", "train", "--multirun", *SMALL, f"sweep={folder}", *overrides]
    environment["PYTHONPATH"] = str(ROOT)
    with open(folder.parent / "output.txt", "w") as output:
        return subprocess.Popen(command, cwd=folder.parent, env=environment, stdout=output, stderr=output)


@pytest.mark.slow
def test_joblib_trains_runs_in_parallel_processes(tiny_npz, folder_of, tmp_path):
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    overrides = [f"data.path={tiny_npz}", "train.learning_rate=0.05,-1", "launcher=joblib", "hydra.launcher.n_jobs=2"]
    assert sweep_process(tmp_path / "sweep", *overrides).wait(300) == 1
    printed = (tmp_path / "output.txt").read_text()
    good, bad = (folder_of(tmp_path / "sweep", f"train.learning_rate={rate}") for rate in ("0.05", "-1"))
    (table,) = read_markdown(printed).values()
    assert [row[0] for row in table] == ["network", "none"] and "Traceback" not in printed
    assert f"{bad}: failed: {(bad / FAILURE).read_text()}" in printed
    log = (good / "train.log").read_text().splitlines()
    assert [line.removeprefix("#0 ") for line in printed.splitlines() if line.startswith("#0 ")] == log


@pytest.mark.slow
def test_a_preempted_job_of_submitit_queues_itself_again_and_ends_with_the_same_weights(
    run_sweep, folder_of, tiny_npz, tmp_path
):
    """The signal comes as from Slurm, to the process that submitit's controller started."""
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher")
    epochs, log = "train.epochs=20", tmp_path / "none"
    process = sweep_process(tmp_path / "jobs", f"data.path={tiny_npz}", epochs, "launcher=submitit_local")
    while not (log.is_file() and "epoch 2/" in log.read_text()):
        assert process.poll() is None
        time.sleep(0.05)
        log = next(tmp_path.glob("jobs/.submitit/*/*_log.out"), log)
    controller = log.name.partition("_")[0]
    os.kill(int(Path(f"/proc/{controller}/task/{controller}/children").read_text()), signal.SIGUSR2)
    assert process.wait(300) == 0
    assert "Requeued job" in log.read_text() and "resumed" in log.read_text()
    assert run_sweep(tmp_path / "undisturbed", epochs) == 0
    require_same_weights(*(folder_of(tmp_path / name, epochs) for name in ("jobs", "undisturbed")))
