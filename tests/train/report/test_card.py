import json
from shutil import copytree

import pytest
from omegaconf import OmegaConf

from renderer.errors import InputError
from train.networks import PUBLISHED, load_run
from train.photographs.figures import FIGURES, figure_title
from train.report.card import publish_run
from train.report.summary import summarize
from train.run_folder import checkpoint
from train.run_folder.checkpoint import BEST


def test_a_published_run_is_a_network_and_a_card_that_names_no_folder_of_this_machine(
    finished, tmp_path, read_markdown, wilson
):
    out = tmp_path / "pretrained" / "tiny-adversarial"
    publish_run(finished, out)
    assert sorted(path.name for path in out.iterdir()) == ["README.md", PUBLISHED]
    network = load_run(out)
    assert network.classes == ("apple", "orange", "pear") and network.function.head.in_features == 64
    card = (out / "README.md").read_text()
    (table,) = read_markdown(card).values()
    rows = dict(table[1:])
    run = summarize(finished)
    assert rows["network"] == "WideResNet-10-1, dropout 0.3"
    assert rows["data"] == "tiny.npz, 10% of training for validation"
    assert rows["augmentation"] == "adversarial; renders each epoch: 4 renders of solid:orange:0, solid:orange:1"
    assert rows["test accuracy"] == f"{run.scores['test/accuracy']:.4f}"
    summary = json.loads((finished / "photographs" / "summary.json").read_text())
    assert rows["photographs: orange recognized"] == wilson(summary["recall"]["hits"], summary["recall"]["n"])
    auc = summary["auc"]
    assert rows["photographs: AUC"] == f"{auc['value']:.3f} [{auc['low']:.3f}, {auc['high']:.3f}]"
    assert [name for name in rows if name.startswith("photographs: ")] == [
        f"photographs: {figure_title(name, 'orange')}" for name in FIGURES
    ]
    assert "run=pretrained/tiny-adversarial photos=" in card
    assert str(finished.parent) not in card and str(tmp_path) not in card


def test_a_card_counts_the_renders_that_the_scene_makes_and_names_the_look_alikes(finished, tmp_path, read_markdown):
    run = copytree(finished, tmp_path / "run")
    config = OmegaConf.load(run / "config.yaml")
    config.scene.hard_negatives = ["solid:fruit", {"mesh": "solid:apple", "label": "apple"}, "solid:fruit"]
    config.scene.views, config.scene.backgrounds, config.augment.examples = 3, [0.2, 0.4], None
    OmegaConf.save(config, run / "config.yaml")
    publish_run(run, tmp_path / "published")
    (table,) = read_markdown((tmp_path / "published" / "README.md").read_text()).values()
    shown = "30 renders of solid:orange:0, solid:orange:1 beside 2 × solid:fruit, solid:apple"
    assert dict(table[1:])["augmentation"] == f"adversarial; renders each epoch: {shown}"


def test_the_card_of_a_soup_says_so(finished, tmp_path):
    run = copytree(finished, tmp_path / "run")
    text = (run / "config.yaml").read_text()
    (run / "config.yaml").write_text(text.replace("soup: false", "soup: true"))
    for folder, words in [(finished, "selected on validation"), (run, "of which the mean is kept")]:
        publish_run(folder, tmp_path / "out")
        assert words in (tmp_path / "out" / "README.md").read_text()


def test_a_network_that_cannot_be_built_is_not_published(finished, tmp_path):
    run = copytree(finished, tmp_path / "run")
    state = checkpoint.load(run / BEST)
    checkpoint.save(run / BEST, state | {"architecture": state["architecture"] | {"width": "wide"}})
    with pytest.raises(InputError, match=r"best\.pt is from another architecture"):
        publish_run(run, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_run_without_its_selected_network_is_not_published(tmp_path, made_up_run):
    with pytest.raises(InputError, match=r"best.pt does not exist"):
        publish_run(made_up_run(tmp_path / "run"), tmp_path / "out")
