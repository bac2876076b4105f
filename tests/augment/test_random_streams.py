import itertools
from unittest import mock

import torch

from augment.random_streams import generator, seeded, stream_seed


def test_a_key_gives_the_same_stream_again_and_leaves_the_global_generator():
    state = torch.random.get_rng_state()
    first = torch.rand(100, generator=generator(3, 7, "lights"))
    assert torch.equal(first, torch.rand(100, generator=generator(3, 7, "lights")))
    assert torch.equal(torch.random.get_rng_state(), state)


def test_a_seeded_block_has_the_numbers_of_its_seed_and_leaves_all_generators():
    state = torch.random.get_rng_state()
    with mock.patch("torch.cuda.manual_seed_all") as seed_gpus, seeded(5):
        numbers = torch.rand(9)
    assert torch.equal(numbers, torch.rand(9, generator=torch.Generator().manual_seed(5)))
    assert torch.equal(torch.random.get_rng_state(), state)
    assert not seed_gpus.called


def test_every_key_has_a_seed_of_its_own_of_63_bits():
    keys = list(itertools.product(range(30), range(30), ["lights", "batches", "dropout"]))
    seeds = {stream_seed(*key) for key in keys}
    assert len(seeds) == len(keys)
    assert min(seeds) >= 0
    assert 2**62 < max(seeds) < 2**63
