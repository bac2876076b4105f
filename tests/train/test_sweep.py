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
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hypothesis import given
from hypothesis import strategies as st
from omegaconf import OmegaConf

from renderer.errors import InputError
from train import loop, sweep
from train.__main__ import main
from train.command_line.entry_points import USER_ERROR
from train.run_folder import checkpoint
from train.run_folder.checkpoint import LAST, content_hash
from train.run_folder.continuation import decisive_settings
from train.run_folder.files import FAILURE, LOCK, locked
from train.run_folder.logs import read_metrics
from train.sweep import cell_name, check_launcher, format_sweep, run_cell

ROOT = Path(__file__).parents[2]
SMALL = [
    "augment=none", "data=npz", "model.depth=10", "model.width=1", "train.epochs=2", "train.batch_size=16",
    "train.learning_rate=0.05", "train.precision=float32", "train.device=cpu", "evaluate.photos=null",
]  # fmt: skip


@pytest.fixture(autouse=True)
def undone(monkeypatch) -> list:
    """What a sweep that does not end leaves in its process: a handler, put back, and calls to come at exit, listed."""
    calls = []
    monkeypatch.setattr(sweep, "report_of", lambda folders, out: f"report: {len(folders)} in {out}")
    monkeypatch.setattr(sweep.atexit, "register", calls.append)
    monkeypatch.setattr(sweep.atexit, "unregister", calls.remove)
    handler = signal.getsignal(signal.SIGTERM)
    yield calls
    signal.signal(signal.SIGTERM, handler)


@pytest.fixture(scope="module")
def run_sweep(tiny_npz):
    """`python -m train --multirun` with a small network in this process, without its logs; its exit status."""

    def run(folder: Path, *overrides: str) -> int | None:
        logs = ["hydra.mode=MULTIRUN", "hydra/job_logging=none", "hydra/hydra_logging=none"]
        with initialize_config_module("conf", version_base="1.3"):
            try:
                GlobalHydra.instance().hydra.multirun(
                    "train", main, [*SMALL, f"data.path={tiny_npz}", f"sweep={folder}", *logs, *overrides]
                )
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
        (["scene.meshes=[a.glb,{mesh:b.glb,albedo_scale:2}]"], "scene.meshes-a.glb_mesh_b.glb_gain_2_@"),
        (["label=Orange"], "label-Orange@"),
        (["+data.note=x"], "_data.note@"),
    ],
)
def test_a_cell_is_named_by_its_overrides(overrides, name):
    found = cell_name(overrides)
    assert found == name if "@" not in name else found.startswith(name)


VALUES = st.text(st.characters(codec="utf-8", exclude_characters="\n"), max_size=60)
CELLS = st.dictionaries(st.sampled_from(["seed", "augment", "data.path", "scene.meshes"]), VALUES)


@given(CELLS, CELLS)
def test_different_cells_have_different_names_that_file_systems_and_command_lines_take(first, second):
    names = [cell_name([f"{key}={value}" for key, value in cell.items()]) for cell in (first, second)]
    assert (names[0].lower() == names[1].lower()) == (first == second)
    for name in names:
        assert len(name.encode()) < 256 and not name.startswith((".", "-"))
        (override,) = OverridesParser.create().parse_overrides([f"run=runs/sweep/{name}"])
        assert override.value() == f"runs/sweep/{name}"


def test_many_overrides_make_a_name_that_is_cut_and_still_differs():
    many = [f"augment.attack.key{number}={'x' * 20}" for number in range(20)]
    names = {cell_name([*many, f"seed={seed}"]) for seed in range(5)}
    assert len(names) == 5 and max(map(len, names)) < 256


# ---------------------------------------------------------------------------------------- what is done and not done


def test_a_second_call_skips_finished_cells_and_shows_them_again(run_sweep, cell, swept, capsys):
    def files():
        cells = [cell(swept, f"seed={seed}") for seed in (0, 1)]
        return {
            path: (path.read_bytes(), path.stat().st_mtime_ns)
            for folder in cells
            for path in folder.rglob("*")
            if path.is_file() and path.name != LOCK
        }

    before = files()
    assert run_sweep(swept, "seed=0,1") == 0
    assert files() == before
    printed = capsys.readouterr().out
    assert f"report: 2 in {swept}\n" in printed
    assert [line for line in printed.splitlines() if line.startswith("finished before")] == [
        f"finished before: {cell(swept, f'seed={seed}')}" for seed in (0, 1)
    ]
    assert [row[:2] for row in rows(printed)] == [
        ["augment", "seed"], ["none", "0"], ["none", "1"], ["augment", "seeds"], ["none", "2"]
    ]  # fmt: skip


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_stops_the_sweep_and_a_second_call_ends_as_if_there_had_been_none(
    run_sweep, cell, swept, tmp_path, monkeypatch, capsys, undone, number
):
    evaluate, calls = loop.evaluate, []

    def interrupted(*arguments):
        calls.append(arguments)
        if len(calls) == 2:
            signal.raise_signal(number)
        return evaluate(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(loop, "evaluate", interrupted)
        try:
            assert run_sweep(tmp_path, "seed=0,1") == 128 + number
        except KeyboardInterrupt:
            assert number == signal.SIGINT
    first, second = (cell(tmp_path, f"seed={seed}") for seed in (0, 1))
    assert (first / LAST).exists() and not second.exists()
    capsys.readouterr()
    (report,) = undone
    report()
    assert capsys.readouterr().out.splitlines()[1::2] == [
        "0 of 2 cells are finished", f"{first}: interrupted", f"{second}: not begun"
    ]  # fmt: skip
    assert run_sweep(tmp_path, "seed=0,1") == 0
    for seed in (0, 1):
        found, expected = (weights(cell(folder, f"seed={seed}") / LAST) for folder in (tmp_path, swept))
        assert all(torch.equal(found[name], expected[name]) for name in expected)
        assert len(read_metrics(cell(tmp_path, f"seed={seed}"))) == 3


def test_a_sweep_that_ends_leaves_no_handler_and_no_call_to_come(run_sweep, swept, undone):
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    assert run_sweep(swept, "seed=0,1") == 0
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_IGN and not undone


def test_a_failed_cell_is_told_with_its_reason_and_tried_again_and_stops_no_other(
    run_sweep, cell, tmp_path, monkeypatch, capsys, caplog
):
    train = sweep.run

    def broken(config, data, folder):
        if config.train.learning_rate == 0.5:
            raise ZeroDivisionError("no fault of the user's")
        train(config, data, folder)

    overrides = ["train.epochs=1", "train.learning_rate=-1,0.05,0.5"]
    wrong, right, unlucky = (
        cell(tmp_path, "train.epochs=1", f"train.learning_rate={r}") for r in ("-1", "0.05", "0.5")
    )
    reasons = {
        wrong: "train.learning_rate=-1.0 must be positive and at most 100000",
        unlucky: "ZeroDivisionError: no fault of the user's",
    }
    with monkeypatch.context() as patch:
        patch.setattr(sweep, "run", broken)
        assert run_sweep(tmp_path, *overrides) == 1
    told = [f"{folder}: failed: {reason}" for folder, reason in reasons.items()]
    printed = capsys.readouterr().out
    assert "1 of 3 cells are finished\n" in printed and [row[0] for row in rows(printed)] == ["augment", "none"]
    assert printed.splitlines()[-3::2] == told
    assert [(folder / FAILURE).read_text() for folder in reasons] == [f"{reason}\n" for reason in reasons.values()]
    assert [record.message for record in caplog.records if record.exc_info] == [f"failed: {reasons[unlucky]}"]

    assert run_sweep(tmp_path, *overrides) == 1
    printed = capsys.readouterr().out
    assert f"finished before: {right}\n" in printed and "2 of 3 cells are finished\n" in printed
    assert printed.splitlines()[-1] == told[0] and not (unlucky / FAILURE).exists()


def test_a_cell_that_another_process_trains_is_left_alone(tiny_config, tmp_path, capsys):
    with locked(tmp_path) as ours:
        assert ours
        run_cell(tiny_config(), tmp_path)
        assert format_sweep([tmp_path]).endswith(f"{tmp_path}: in training")
    assert capsys.readouterr().out == f"in training elsewhere: {tmp_path}\n"
    assert [path.name for path in tmp_path.iterdir()] == [LOCK]


# ---------------------------------------------------------------------------------------- what is refused


def edited(swept: Path, cell, folder: Path, key: str, value: object) -> Path:
    """A copy of the sweep in `folder` whose first cell was run with another setting; the cell."""
    shutil.copytree(swept, folder)
    config = OmegaConf.load(cell(folder, "seed=0") / "config.yaml")
    OmegaConf.update(config, key, value, force_add=True)
    OmegaConf.save(config, cell(folder, "seed=0") / "config.yaml")
    return cell(folder, "seed=0")


@pytest.mark.parametrize("finished", [True, False])
@pytest.mark.parametrize(
    "key, value, difference",
    [
        ("train.epochs", 7, "train.epochs=7, and 2 is asked for"),
        ("scene.backgrounds", [0.5], "scene.backgrounds=[0.5], and [0.0, 0.25, 0.5, 0.75, 1.0] is asked for"),
        ("train.of_old", True, "train.of_old=True, and None is asked for"),
    ],
)
def test_a_cell_with_other_settings_is_refused_before_any_is_trained(
    run_sweep, cell, swept, tmp_path, capsys, key, value, difference, finished
):
    folder = edited(swept, cell, tmp_path / "edited", key, value)
    if not finished:
        (folder / "metrics.jsonl").unlink()
    assert run_sweep(tmp_path / "edited", "seed=2,0") == USER_ERROR
    error = f"error: {folder} has {difference}: give another folder with sweep=, or remove this one\n"
    assert capsys.readouterr() == ("", error)
    assert not cell(tmp_path / "edited", "seed=2").exists()


@pytest.mark.parametrize("key, value", [("versions.torch", "2.6"), ("train.resume", True), ("run", "elsewhere")])
def test_circumstances_may_change(run_sweep, cell, swept, tmp_path, key, value):
    folder = edited(swept, cell, tmp_path / "edited", key, value)
    config = (folder / "config.yaml").read_bytes()
    assert run_sweep(tmp_path / "edited", "seed=0,1") == 0
    assert (folder / "config.yaml").read_bytes() == config


@pytest.mark.parametrize("name", ["config.yaml", "metrics.jsonl"])
def test_a_finished_cell_whose_files_are_damaged_ends_the_sweep_with_one_sentence(
    run_sweep, cell, swept, tmp_path, capsys, name
):
    shutil.copytree(swept, tmp_path / "damaged")
    file = cell(tmp_path / "damaged", "seed=0") / name
    file.write_bytes(b"\xff{" + file.read_bytes())
    assert run_sweep(tmp_path / "damaged", "seed=0,1") == USER_ERROR
    printed = capsys.readouterr()
    assert printed.out == "" and len(printed.err.splitlines()) == 1
    assert printed.err.startswith(f"error: {file} is damaged or no file that `python -m train` wrote")


@pytest.mark.parametrize("callback", ["_compose_cells", "format_sweep"])
def test_whatever_fails_in_a_sweeps_checks_or_table_is_no_success(run_sweep, swept, monkeypatch, capsys, callback):
    def broken(*arguments):
        raise ZeroDivisionError

    monkeypatch.setattr(sweep, callback, broken)
    assert run_sweep(swept, "seed=0,1") == 1
    assert "ZeroDivisionError" in capsys.readouterr().err


@pytest.mark.parametrize(
    "override, error",
    [
        ("seed=3,3", "the sweep asks twice for {cell}: give each value once"),
        ("run=here", "run= names the folder of a single run: name a sweep's with sweep="),
    ],
)
def test_a_sweep_that_cannot_be_meant_is_one_sentence(run_sweep, cell, tmp_path, capsys, override, error):
    assert run_sweep(tmp_path / "none", override) == USER_ERROR
    assert capsys.readouterr().err == f"error: {error.format(cell=cell(tmp_path / 'none', 'seed=3'))}\n"
    assert not (tmp_path / "none").exists()


def test_what_decides_a_result_is_all_but_its_folder_and_circumstances(tiny_config):
    def settings(*overrides):
        return decisive_settings(tiny_config("+data.images=${run}/images", *overrides))

    here = settings("run=here")
    assert here["data.images"] == "${run}/images" and here["augment.attack.max_steps"] == 3
    assert settings("run=there/a", "sweep=x", "train.resume=true", "renderer.cache=null", "compare=[none]") == here
    changed = settings("run=here", "train.epochs=4")
    assert {key for key in here if here[key] != changed[key]} == {"train.epochs"} and changed.keys() == here.keys()


# ---------------------------------------------------------------------------------------- launchers


@pytest.mark.parametrize(
    "launcher, package, extra",
    [
        ("joblib", "hydra-joblib-launcher", "joblib"),
        ("slurm", "hydra-submitit-launcher", "slurm"),
        ("submitit_local", "hydra-submitit-launcher", "slurm"),
    ],
)
def test_a_launcher_without_its_extra_is_one_sentence(monkeypatch, launcher, package, extra):
    def missing(name):
        raise sweep.importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(sweep.importlib.metadata, "distribution", missing)
    check_launcher(["launcher=basic", "seed=0", "scene.light=joblib"])
    with pytest.raises(InputError) as caught:
        check_launcher(["seed=0", f"launcher={launcher}"])
    assert str(caught.value) == f'launcher={launcher} needs {package}: pip install ".[{extra}]"'


def test_torchrun_starts_no_sweep(monkeypatch):
    monkeypatch.setenv("TORCHELASTIC_RUN_ID", "none")
    check_launcher(["seed=0,1"])
    with pytest.raises(InputError, match=r"start a sweep with python -m train --multirun"):
        check_launcher(["--multirun", "seed=0,1"])


def command(folder: Path, *overrides: str) -> subprocess.CompletedProcess:
    """`python -m train --multirun` with a small network in processes of its own."""
    with started(folder, *overrides) as process:
        out, errors = process.communicate()
    return subprocess.CompletedProcess(process.args, process.returncode, out, errors)


def started(folder: Path, *overrides: str) -> subprocess.Popen:
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
def test_every_launchers_keys_are_keys_that_its_plugin_has(launcher, name):
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher")
    with initialize_config_module("conf", version_base="1.3"):
        config = compose("train", [f"launcher={launcher}"], return_hydra_config=True)
    assert config.hydra.launcher._target_.endswith(f".{name}")


def test_slurm_where_there_is_none_is_one_line(call, capsys, tmp_path, monkeypatch):
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher")
    monkeypatch.setenv("PATH", str(tmp_path))
    assert call("train", "--multirun", f"sweep={tmp_path / 'sweep'}", "launcher=slurm", "seed=0,1") == USER_ERROR
    error = "error: launcher=slurm needs Slurm's sbatch, which is not here: start the sweep on the cluster\n"
    assert capsys.readouterr() == ("", error)


def test_joblib_trains_cells_in_processes_at_once(tiny_npz, cell, tmp_path):
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    folder = tmp_path / "sweep"
    overrides = [f"data.path={tiny_npz}", "train.learning_rate=0.05,-1", "launcher=joblib", "hydra.launcher.n_jobs=2"]
    done = command(folder, *overrides)
    assert done.returncode == 1 and "Traceback" not in done.stderr and "nearest" not in done.stderr
    good, bad = (cell(folder, "train.epochs=1", f"train.learning_rate={rate}") for rate in ("0.05", "-1"))
    assert {path for path in folder.iterdir() if path.is_dir()} == {good, bad}
    assert [row[0] for row in rows(done.stdout)] == ["augment", "none"]
    assert done.stdout.splitlines()[-1] == f"{bad}: failed: {(bad / FAILURE).read_text().strip()}"
    assert f"#1 failed: {(bad / FAILURE).read_text()}" in done.stdout
    said = (good / "train.log").read_text().splitlines()
    assert [line.removeprefix("#0 ") for line in done.stdout.splitlines() if line.startswith("#0 ")] == said


def test_submitits_executor_trains_cells_in_jobs(tiny_npz, cell, tmp_path):
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher")
    folder = tmp_path / "sweep"
    done = command(folder, f"data.path={tiny_npz}", "launcher=submitit_local")
    assert done.returncode == 0, done.stderr
    trained = cell(folder, "train.epochs=1")
    assert {path for path in folder.iterdir() if path.is_dir()} == {
        trained,
        folder / ".submitit",
    }
    assert [row[:2] for row in rows(done.stdout)] == [["augment", "seed"], ["none", "0"]]
    (log,) = (folder / ".submitit").glob("*/*_log.out")
    assert "epoch 1/1" in log.read_text() and "epoch 1/1" not in done.stdout


@pytest.mark.slow
def test_a_preempted_job_queues_itself_again_and_ends_with_the_same_bits(tiny_npz, cell, tmp_path):
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher")
    long = [f"data.path={tiny_npz}", "train.epochs=20"]
    undisturbed = command(tmp_path / "undisturbed", *long)
    assert undisturbed.returncode == 0, undisturbed.stderr
    folder = tmp_path / "preempted"
    with started(folder, *long, "launcher=submitit_local") as process:
        (log,) = wait_for(lambda: [file for file in folder.glob(".submitit/*/*.out") if "epoch 2/" in file.read_text()])
        (job,) = (int(each.parent.name) for each in Path("/proc").glob("[0-9]*/cmdline") if is_job(each, folder))
        os.kill(job, signal.SIGUSR2)  # as Slurm does where the job is preempted
        assert process.wait(300) == 0
    assert "Requeued job" in log.read_text() and "resumed" in log.read_text()
    states = [checkpoint.load(cell(each, *long) / LAST) for each in (tmp_path / "undisturbed", folder)]
    assert states[0]["epoch"] == states[1]["epoch"] and content_hash(states[0]["model"]) == content_hash(
        states[1]["model"]
    )


def wait_for(found, seconds=120):
    """What is found in the end."""
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
