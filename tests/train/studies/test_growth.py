import pytest

from train.studies.growth.cost import Cost, Load, described, measure, sure_network
from train.studies.growth.imagenet import IMAGES, Parts, added_share
from train.studies.growth.study import GrowthSettings, _further, on_paper, run

PARTS = Parts(training=2.0, attack=1.0, render=0.5)


def test_an_epoch_with_as_many_renders_as_images_takes_their_attacks_and_their_training_longer():
    assert added_share(PARTS, IMAGES, 3) == pytest.approx((4 * 1.5 + 2.0) / 2.0)
    assert added_share(PARTS, IMAGES // 1000, 30) == pytest.approx((31 * 1.5 + 2.0) / 2.0 / 1000, rel=1e-3)


def test_imagenet_on_paper_scales_what_was_measured():
    table = on_paper(PARTS, 1.5, 10**7, {"8 of them": IMAGES // 60})
    *_, last = table.splitlines()
    share = 100_000 * 24.25 / IMAGES  # 31 passes of 1.5, and 2 for training, of the 2 that an image takes
    assert last.split(" | ")[2:] == [f"+{share:.2%}", f"{1 + share:.1f}", "500.0", "200.0 |"]


def test_more_renders_go_on_as_they_began():
    loads = [Load(1000), Load(10_000)]
    costs = {load: Cost(0, 2 + load.renders / 100, 1, 1, 1, 10**6 + 10**5 * load.renders) for load in loads}
    assert _further(10**5, costs) == "100,000 renders would take 1,002 s and 10.0 GB"
    assert _further(10**6, costs) == "1,000,000 renders would take 10,002 s and 100.0 GB"


def test_a_load_says_what_is_not_usual_and_its_network_takes_all_steps():
    assert (
        described(Load(), Load()) == "as it is" and described(Load(1000, size=64), Load()) == "renders 1,000, size 64"
    )
    assert Load(1000, meshes=4).views == 50
    assert sure_network().head.bias[0] > 20


@pytest.mark.slow
@pytest.mark.parametrize("processes", [1, 2])
def test_a_round_is_measured_in_processes_of_its_own(processes):
    cost = measure(Load(10, size=16, processes=processes, steps=1))
    assert cost.operators > 0 and cost.attack > 0 and 0 < cost.network < 1 and cost.memory > cost.kept > 10**5


@pytest.mark.slow
def test_the_study_writes_its_page(tmp_path):
    run(GrowthSettings(str(tmp_path / "page.md"), [5, 10], [16, 224], [2], 10, [1, 2], 1, 1, {"8 of them": 1000}))
    page = (tmp_path / "page.md").read_text()
    assert page.count("\n| ") == 3 * 2 + 5 + 2 + 5  # headers and lines, and rows
    assert "a view's operators" in page and "{" not in page
