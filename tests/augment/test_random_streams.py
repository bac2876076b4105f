"""Random streams by key."""

import itertools

import torch

from augment.random_streams import generator, stream_seed


def test_every_key_seeds_another_stream_and_leaves_the_global_generator():
    state = torch.random.get_rng_state()
    first, again = (torch.rand(100, generator=generator(3, 7, "lights")) for _ in range(2))
    assert torch.equal(first, again) and torch.equal(torch.random.get_rng_state(), state)
    keys = list(itertools.product(range(30), range(30), ["lights", "batches", "dropout"]))
    seeds = {stream_seed(*key) for key in keys}
    assert len(seeds) == len(keys) and min(seeds) >= 0 and 2**62 < max(seeds) < 2**63
