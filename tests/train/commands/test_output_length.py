"""A command prints at most fifteen lines, however much it worked on. The rest is in its files."""

from pathlib import Path

import pytest

from train.commands.sweep import format_sweep

pytestmark = pytest.mark.slow
PRETRAINED = Path(__file__).parents[3] / "pretrained"
MAX_LINES = 15
SOLIDS = ",".join(f"solid:orange:{seed}" for seed in range(14))
ATTACK = [
    *(f"network=run:{PRETRAINED / 'none'}", "attack.max_steps=1", "attack.force=true"),
    *("attack.checks=false", "attack.verify=null", "device=cpu", "renderer.rasterizer=numpy"),
    "renderer.shadows=false",
]


@pytest.fixture
def sweep(made_up_run, tmp_path) -> list[Path]:
    folders = [tmp_path / f"sweep/{index}" for index in range(24)]
    auc = {"value": 0.5, "low": 0.4, "high": 0.6}
    scores = {"images": "same", "label": "orange", "auc": auc}
    for index, folder in enumerate(folders[:12]):
        rate = f"train.learning_rate={index + 1}"
        made_up_run(folder, "none", {"photographs": scores}, rate)
    return folders


@pytest.mark.parametrize(
    "words",
    [
        ["attack", f"meshes=[{SOLIDS}]", *ATTACK],
        ["compare", f"runs=[{','.join(f'sweep/{index}' for index in range(12))}]"],
        ["report", "runs=[sweep]", "out=page"],
    ],
    ids=lambda words: " ".join(words)[:40],
)
def test_a_command_prints_at_most_fifteen_lines(call, sweep, capsys, words):
    assert call(*words) == 0
    printed = capsys.readouterr()
    lines = (printed.out + printed.err).splitlines()
    assert 1 <= len(lines) <= MAX_LINES


@pytest.mark.parametrize("is_complete", [True, False])
def test_the_result_of_a_large_sweep_leaves_lines_for_its_report(sweep, is_complete):
    lines = format_sweep(sweep[:12] if is_complete else sweep).splitlines()
    assert 1 <= len(lines) <= MAX_LINES - 2
