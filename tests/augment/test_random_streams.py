import itertools

import torch

from augment.random_streams import generator, stream_seed


def test_a_key_gives_the_same_stream_again_and_leaves_the_global_generator():
    state = torch.random.get_rng_state()
    first = torch.rand(100, generator=generator(3, 7, "lights"))
    assert torch.equal(first, torch.rand(100, generator=generator(3, 7, "lights")))
    assert torch.equal(torch.random.get_rng_state(), state)


def test_every_key_has_a_seed_of_its_own_of_63_bits():
    keys = list(itertools.product(range(30), range(30), ["lights", "batches", "dropout"]))
    seeds = {stream_seed(*key) for key in keys}
    assert len(seeds) == len(keys)
    assert min(seeds) >= 0
    assert 2**62 < max(seeds) < 2**63
