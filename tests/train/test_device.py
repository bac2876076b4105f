import pytest
import torch

from renderer.errors import InputError
from train import device
from train.device import choose_device, set_deterministic, set_threads


@pytest.fixture(autouse=True)
def as_it_was():
    threads, deterministic = torch.get_num_threads(), torch.are_deterministic_algorithms_enabled()
    yield
    torch.set_num_threads(threads)
    torch.use_deterministic_algorithms(deterministic)


def test_a_device_that_is_not_there_is_one_error():
    for name in ("abacus", "cuda:99"):
        with pytest.raises(InputError, match=f"device={name} is not available here: use cpu"):
            choose_device(name)


@pytest.mark.parametrize(
    "quota, cores", [("150000 100000", 1), ("300000 100000", 3), ("20000 100000", 1), ("max 100000", 8), (None, 8)]
)
def test_threads_are_no_more_than_the_containers_quota_of_cores(tmp_path, monkeypatch, quota, cores):
    if quota:
        (tmp_path / "cpu.max").write_text(quota)
    monkeypatch.setattr(device, "QUOTA", tmp_path / "cpu.max")
    monkeypatch.setattr(device.os, "cpu_count", lambda: 8)
    torch.set_num_threads(8)
    set_threads(None)
    assert torch.get_num_threads() == cores
    set_threads(5)
    assert torch.get_num_threads() == 5


def test_threads_that_the_user_has_limited_stay_limited():
    torch.set_num_threads(1)
    set_threads(None)
    assert torch.get_num_threads() == 1


@pytest.mark.parametrize("deterministic", [True, False])
def test_determinism_is_as_asked(monkeypatch, deterministic):
    monkeypatch.delenv("CUBLAS_WORKSPACE_CONFIG", raising=False)
    set_deterministic(deterministic)
    assert torch.are_deterministic_algorithms_enabled() == deterministic
    assert torch.backends.cudnn.benchmark != deterministic
    assert ("CUBLAS_WORKSPACE_CONFIG" in device.os.environ) == deterministic
