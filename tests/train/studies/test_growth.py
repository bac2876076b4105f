import pytest

from train.studies.growth.cost import Cost, Load, described, measure, sure_network
from train.studies.growth.imagenet import IMAGES, Parts, added_share
from train.studies.growth.study import _extrapolated, _shared


def test_an_epoch_with_as_many_renders_as_images_takes_their_attacks_and_their_training_longer():
    parts = Parts(training=2.0, attack=1.0, render=0.5)
    assert added_share(parts, IMAGES, 3) == pytest.approx((4 * 1.5 + 2.0) / 2.0)
    assert added_share(parts, IMAGES // 1000, 30) == pytest.approx((31 * 1.5 + 2.0) / 2.0 / 1000, rel=1e-3)


def test_a_straight_line_goes_on_as_it_began():
    loads = [Load(100), Load(1000), Load(10_000)]
    costs = {load: Cost(0, 2 + load.renders / 100, 1, 10**6 + 10**5 * load.renders) for load in loads}
    assert "straight line: 1,002 s, 10.0 GB; 1,000,000: 100.0 GB." in " ".join(_extrapolated(loads, costs).split())


@pytest.mark.parametrize(("two", "told"), [(5.0, "0%"), (10.0, "100%"), (7.5, "50%"), (12.0, "100%")])
def test_what_a_second_process_does_not_save_is_serial(two, told):
    loads = [Load(1000, processes=count) for count in (1, 2)]
    costs = dict(zip(loads, [Cost(0, 10.0, 1, 1), Cost(0, two, 1, 1)], strict=True))
    assert f"by a second process is {told} of" in " ".join(_shared(loads, costs).split())


def test_a_load_says_what_is_not_usual_and_its_network_takes_all_steps():
    assert described(Load()) == "default" and described(Load(1000, size=64)) == "renders 1,000, size 64"
    assert Load(1000, meshes=4).views == 50
    assert sure_network().head.bias[0] > 20


@pytest.mark.slow
@pytest.mark.parametrize("processes", [1, 2])
def test_a_round_is_measured_in_processes_of_its_own(processes):
    cost = measure(Load(10, size=16, processes=processes, steps=1))
    assert cost.operators > 0 and cost.attack > cost.classifier > 0 and cost.memory > 10**6
