import pytest
import torch
import torch.nn.functional as F

from train.wideresnet import Dropout

LAYOUTS = [torch.contiguous_format, torch.channels_last]


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_values_are_dropped_or_scaled_so_that_their_mean_stays(layout, dtype):
    x = torch.ones(16, 32, 31, 33, dtype=dtype).contiguous(memory_format=layout)
    torch.manual_seed(0)
    y = Dropout(0.3)(x)
    assert y.dtype == dtype and y.is_contiguous(memory_format=layout)
    factor = torch.tensor(1 / 0.7).to(dtype)
    kept = y != 0
    torch.testing.assert_close(y[kept], factor.expand(int(kept.sum())), rtol=2**-15, atol=0)  # p is a multiple of 2⁻¹⁶
    deviation = (0.3 * 0.7 / x.numel()) ** 0.5
    assert abs(kept.double().mean() - 0.7) < 4 * deviation


@pytest.mark.parametrize("layout", LAYOUTS)
def test_neighbors_are_dropped_independently(layout):
    torch.manual_seed(0)
    dropped = (Dropout(0.3)(torch.ones(8, 16, 64, 64).contiguous(memory_format=layout)) == 0).double() - 0.3
    for dim in range(4):
        pairs = dropped.narrow(dim, 1, dropped.shape[dim] - 1) * dropped.narrow(dim, 0, dropped.shape[dim] - 1)
        assert abs(pairs.mean()) < 4 * 0.21 / pairs.numel() ** 0.5  # four standard deviations of a product's mean


def test_the_gradient_passes_where_values_do():
    x = torch.randn(4, 8, 5, 7, requires_grad=True)
    y = Dropout(0.5)(x)
    y.sum().backward()
    assert torch.equal(x.grad, torch.where(y != 0, 2.0, 0.0))


def test_draws_follow_torchs_seed_and_move_on():
    x, dropout = torch.ones(1000), Dropout(0.5)
    torch.manual_seed(3)
    first, second = dropout(x), dropout(x)
    torch.manual_seed(3)
    assert torch.equal(dropout(x), first) and not torch.equal(first, second)


def test_nothing_is_dropped_or_drawn_in_eval_mode_or_at_zero():
    x = torch.randn(10)
    torch.manual_seed(0)
    state = torch.get_rng_state()
    assert Dropout(0.5).eval()(x) is x and Dropout(0.0)(x) is x
    assert torch.equal(torch.get_rng_state(), state)


@pytest.mark.parametrize("size", [0, 1, 2, 3, 5])
def test_any_number_of_values_will_do(size):
    assert Dropout(0.5)(torch.ones(size)).shape == (size,)


def test_almost_all_and_almost_none_are_dropped():
    x = torch.ones(10**6)
    assert (Dropout(1 - 2**-16)(x) != 0).sum() < 50  # 15 expected
    assert (Dropout(2**-16)(x) == 0).sum() < 50
    torch.testing.assert_close(F.dropout(x, 2**-16).max(), Dropout(2**-16)(x).max())
