import re
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from torch import nn

from renderer.errors import InputError
from train.command_line.configuration import composed
from train.data import Split, load_npz
from train.fit.epoch import Round, training_batches
from train.fit.recipe import TrainSettings
from train.settings import ExperimentSettings
from train.studies.training_speed import peak
from train.studies.training_speed.baseline import Baseline, build_loader, use_plain_dropout
from train.studies.training_speed.contest import BenchmarkSettings, compete, measure, take_turns
from train.studies.training_speed.findings import (
    ADVERSARIAL,
    BASELINE,
    PLAIN,
    PRODUCTS,
    Findings,
    Spread,
    Workload,
    targets,
)
from train.studies.training_speed.study import run as write_page
from train.studies.training_speed.study import section
from train.wideresnet import WideResNet

ROOT = Path(__file__).parents[3]
CPU = torch.device("cpu")
TINY = [
    "model.depth=10",
    "model.width=1",
    "train.batch_size=8",
    "train.device=cpu",
    "train.precision=float32",
    "train.threads=1",
    "augment.examples=10",
    "renderer.samples=1",
    "workers=0",
]


def settings(name: str, *overrides: str) -> OmegaConf:
    return composed(name, overrides)


@pytest.fixture
def npz(tmp_path) -> Path:
    draws, path = np.random.default_rng(0), tmp_path / "tiny.npz"
    arrays = {}
    for part, count in (("train", 80), ("test", 8)):
        arrays[f"{part}_images"] = draws.integers(0, 256, (count, 3, 32, 32), dtype=np.uint8)
        arrays[f"{part}_labels"] = np.arange(count) % 2
    np.savez(path, classes=np.array(["apple", "orange"]), **arrays)
    return path


# ---------------------------------------------------------------------------- multiply-adds


def multiply_adds(depth: int, width: int, classes: int, size: int) -> int:
    """A 3×3 convolution has 9 × inputs × outputs per pixel, a shortcut's 1×1 one a ninth of that."""
    total, inputs = 27 * 16 * size**2, 16
    for group in range(3):
        outputs, pixels = 16 * width * 2**group, (size // 2**group) ** 2
        if inputs != outputs:
            total += inputs * outputs * pixels
        total += 9 * (inputs * outputs + (2 * (depth - 4) // 6 - 1) * outputs**2) * pixels
        inputs = outputs
    return total + inputs * classes


@pytest.mark.parametrize(("depth", "width", "classes", "size"), [(10, 1, 10, 16), (16, 2, 3, 32), (16, 4, 100, 32)])
def test_multiply_adds_are_those_of_the_formula(depth, width, classes, size):
    network = WideResNet(classes, depth, width)
    assert peak.forward_multiply_adds(network, size) == multiply_adds(depth, width, classes, size)


# ---------------------------------------------------------------------------- the baseline


def test_the_baselines_loader_draws_the_same_images_as_ours():
    """All 9² shifts, flipped or not, of one image; 3,000 draws miss one of the 162 once in 10⁶ times."""
    images = torch.randint(0, 256, (1, 3, 32, 32), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    split = Split(images.expand(3000, -1, -1, -1), torch.zeros(3000, dtype=torch.int64))
    mean, std = (0.5, 0.4, 0.3), (0.2, 0.3, 0.4)
    torch.manual_seed(0)
    theirs = list(build_loader(split, 128, mean, std, 0, CPU))
    ours = list(training_batches(split.images, split.labels, 128, 0, Round(0, 0, torch.arange(len(split)))))
    assert [part.shape for part in theirs[0]] == [part.shape for part in ours[0][:2]]

    scale, offset = (torch.tensor(values).view(3, 1, 1) for values in (std, mean))
    restored = [((images * scale + offset) * 255).round().to(torch.uint8) for images, _ in theirs]
    seen, expected = (
        {image.numpy().tobytes() for image in torch.cat(batches)}
        for batches in (restored, [images for images, *_ in ours])
    )
    assert seen == expected and len(seen) == 9**2 * 2


def test_the_baselines_network_is_ours_with_torchs_dropout():
    network = WideResNet(3, 10, 1, dropout=0.3)
    before = {name: type(module) for name, module in network.named_modules()}
    use_plain_dropout(network)
    after = dict(network.named_modules())
    changed = {name for name, kind in before.items() if kind is not type(after[name])}
    assert changed == {f"groups.{group}.0.dropout" for group in range(3)}
    assert all(type(after[name]) is nn.Dropout and after[name].p == 0.3 for name in changed)


def test_a_turn_of_the_baseline_is_one_step_for_each_batch(npz):
    train, network = load_npz(npz).train, WideResNet(2, 10, 1)
    baseline = Baseline(network, build_loader(train, 32, (0, 0, 0), (1, 1, 1), 0, CPU), TrainSettings(), CPU)
    weights = network.head.weight.detach().clone()
    assert baseline()["training"] > 0
    assert network.norm.num_batches_tracked == 3  # of 80 images
    assert not torch.equal(network.head.weight, weights)


# ---------------------------------------------------------------------------- turns


def test_contestants_take_turns_in_every_round():
    order = []

    def maker(name):
        return lambda: lambda: order.append(name) or {name: len(order)}

    assert take_turns({name: maker(name) for name in "ab"}, 2) == {
        "a": [{"a": 1}, {"a": 3}, {"a": 5}],
        "b": [{"b": 2}, {"b": 4}, {"b": 6}],
    }


@pytest.mark.parametrize(("device", "order"), [("cpu", "pbmpbmpbmpbmaa"), ("cuda", "ppppbbbbmmmmaaaa")])
def test_long_attacks_come_last_on_a_cpu_and_one_after_the_other_on_a_gpu(device, order):
    """In three rounds and one before them, of which a CPU's adversarial arm takes a third."""
    taken = []
    names = {"p": PLAIN, "b": BASELINE, "m": PRODUCTS, "a": ADVERSARIAL}
    makers = {name: lambda short=short: lambda: taken.append(short) for short, name in names.items()}
    turns = compete(makers, 3, torch.device(device))
    assert "".join(taken) == order and list(turns) == list(names.values())


# ---------------------------------------------------------------------------- arithmetic


def turn(training: float, evaluation: float, attack: float = 0.0, rest: float = 0.0, **more) -> dict[str, float]:
    phases = {"training": training, "evaluation": evaluation, "attack": attack, "input_output": 0.5}
    return phases | {"epoch": sum(phases.values()) + rest, "steps": 30.0} | more


def findings(device: str, steps: int | None, plain: list, adversarial: list, baseline: list) -> Findings:
    turns = {
        PLAIN: plain,
        ADVERSARIAL: adversarial,
        BASELINE: [{"training": seconds} for seconds in baseline],
        PRODUCTS: [
            {("bfloat16", 512): 4e9, ("bfloat16", 1024): 2e9, ("float32", 512): 1e9},
            {("bfloat16", 512): 3e9, ("bfloat16", 1024): 1e9, ("float32", 512): 5e8},
        ],
    }
    return Findings(device, "bfloat16", 1_000_000, Workload(1000, 300, 100, 100, steps), turns)


SHORTENED = findings(
    "cpu",
    2,
    plain=[turn(9, 1), turn(0.6, 0.5), turn(0.5, 0.4), turn(0.8, 0.3)],
    adversarial=[turn(9, 9, 3, operators=2.0), turn(9, 9, 0.3), turn(9, 9, 0.9, rest=0.1)],
    baseline=[9, 1.2, 2.0, 2.0],
)
WHOLE = findings(
    "cuda",
    None,
    plain=[turn(9, 1), turn(1.0, 0.5), turn(1.2, 0.3)],
    adversarial=[turn(19.1, 0.4, 0.1, operators=2.0), turn(1.1, 0.4, 0.0), turn(1.1, 0.4, 0.2)],
    baseline=[9, 8.8, 13.2],
)


def test_shortened_turns_are_scaled_to_an_epoch():
    """10 and 11 steps of 2, and 300 images of 200 to validate on."""
    assert SHORTENED.epochs(PLAIN)[0] == pytest.approx(
        {"attack": 0, "training": 3, "evaluation": 0.75, "input_output": 0.5, "everything else": 0}
    )
    assert SHORTENED.epochs(ADVERSARIAL)[1] == pytest.approx(
        {"attack": 0.9, "training": 3.3, "evaluation": 0.6, "input_output": 0.5, "everything else": 0.1}
    )


def test_whole_turns_are_as_measured():
    assert WHOLE.totals(PLAIN) == pytest.approx([2.0, 2.0])
    assert WHOLE.totals(ADVERSARIAL) == pytest.approx([2.0, 2.2])


def test_rates_and_shares_are_those_of_the_median_turn():
    """200 images in 0.6 s; an operation is half a multiply-add, and a training step three forward passes."""
    assert SHORTENED.rate(PLAIN) == Spread(200 / 0.6, 200 / 0.8, 200 / 0.5)
    assert SHORTENED.rate(BASELINE).median == 100
    assert SHORTENED.operations(BASELINE) == pytest.approx(6e8)
    assert SHORTENED.peaks == {"bfloat16": (4e9, 512), "float32": (1e9, 512)}
    assert SHORTENED.share(PLAIN, "bfloat16") == pytest.approx(0.5)
    assert (SHORTENED.speedup.least, SHORTENED.speedup.most) == pytest.approx((2.0, 4.0))


def test_a_run_is_its_start_and_150_median_epochs():
    assert WHOLE.operators(ADVERSARIAL) == 2.0
    assert WHOLE.warm_up(ADVERSARIAL) == pytest.approx(20.1 - 2.1)
    assert WHOLE.whole_run(ADVERSARIAL) == pytest.approx(2.0 + 18.0 + 150 * 2.1)
    assert WHOLE.longer == Spread(*(pytest.approx(value, abs=1e-12) for value in (0.05, 0.0, 0.1)))


def test_only_the_devices_own_targets_are_judged():
    """On the CPU: 2.5 of 2.5 asked, half the peak asked and reached but for rounding; on the GPU 335 s are too many."""
    judged = {
        name: [target.passed for target in targets(found)] for name, found in (("cpu", SHORTENED), ("gpu", WHOLE))
    }
    assert judged["cpu"][:2] == [None, None] and judged["gpu"][2:4] == [None, None]
    assert judged["gpu"] == [True, False, None, None, True]
    assert judged["cpu"][2] is True and judged["cpu"][4] is False


@pytest.mark.parametrize(
    ("found", "says"),
    [(SHORTENED, "shortened to 200 images, and 200 to validate on"), (WHOLE, "a whole epoch, 1,000 images")],
    ids=["cpu", "gpu"],
)
def test_the_page_says_what_a_turn_was(found, says):
    text = section(found, dict.fromkeys(("command", "machine", "network", "data", "compiled", "workers"), "…"))
    assert says in " ".join(text.split()) and "{" not in text
    assert ("TF32 " in text) == (found.device == "cuda")


@pytest.mark.parametrize(("name", "value"), [("epochs", 0), ("steps", -1), ("workers", -1)])
def test_settings_out_of_range_name_their_key(name, value):
    with pytest.raises(InputError, match=f"{name}={value} must be at least"):
        BenchmarkSettings("page.md", **{name: value})


# ---------------------------------------------------------------------------- the script


@pytest.fixture
def one_thread():
    threads = torch.get_num_threads()
    yield
    torch.set_num_threads(threads)


def test_a_tiny_run_writes_the_page(tmp_path, npz, monkeypatch, capsys, one_thread):
    monkeypatch.setitem(peak.SIZES, "cpu", (32,))
    monkeypatch.setattr(peak, "BURST", 1e-9)
    monkeypatch.setattr(
        sys, "argv", ["scripts/benchmark_training.py", f"data.path={npz}", "scene.meshes=[/home/a.glb,{mesh:../b.glb}]"]
    )
    overrides = [*TINY, "data=npz", f"data.path={npz}", f"out={tmp_path}/docs/page.md", "epochs=1", "steps=1"]
    write_page(settings("benchmark_training", *overrides))

    text = (tmp_path / "docs" / "page.md").read_text()
    assert text in capsys.readouterr().out
    words = " ".join(text.split())
    assert "`python scripts/benchmark_training.py data.path=tiny.npz 'scene.meshes=[a.glb,{mesh:b.glb}]'`: " in words
    assert "(30 on average, of 10 renders)" in words
    rows = {cells[0]: cells[1:] for line in text.splitlines() if (cells := re.findall(r"(?<=\| ).*?(?= \|)", line))}
    assert [float(cell.split()[0]) > 0 for cell in rows["training"]] == [True, True]
    assert [float(cell.split()[0]) > 1e-3 for cell in rows["attack"]] == [False, True]
    assert "nan" not in text and str(tmp_path) not in text


def test_whole_epochs_count_every_image(npz, one_thread, monkeypatch):
    """72 images in training and 8 in validation, in 9 batches, and 11 with the 10 renders."""
    monkeypatch.setitem(peak.SIZES, "cpu", (32,))
    monkeypatch.setattr(peak, "BURST", 1e-9)
    config = settings("benchmark_training", *TINY, "data=npz", f"data.path={npz}", "epochs=2", "steps=0")
    own = BenchmarkSettings("", config.epochs, config.steps, config.workers)
    found = measure(own, OmegaConf.masked_copy(config, list(ExperimentSettings.__annotations__)), load_npz(npz), CPU)
    work = found.workload
    assert (work.trained, work.validated, work.beside_renders) == (72, 8, 72)
    assert (work.batches(PLAIN), work.batches(ADVERSARIAL)) == (9, 11)
    for name in (PLAIN, ADVERSARIAL):
        assert found.totals(name) == pytest.approx([measured["epoch"] for measured in found.turns[name][1:]])
        assert all(found.epochs(name)[0][phase] > 0 for phase in ("training", "evaluation", "input_output"))
    assert found.attack_steps == 30 and found.operators(ADVERSARIAL) > 0
