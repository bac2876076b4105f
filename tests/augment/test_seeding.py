import itertools
import os
import subprocess
import sys
from pathlib import Path

import torch

from augment.utils import generator, stream_seed

ROOT = Path(__file__).parents[2]


def test_the_same_key_repeats_its_draws_and_leaves_the_global_generator():
    state = torch.random.get_rng_state()
    first, again = (torch.rand(100, generator=generator(3, 7, "lights")) for _ in range(2))
    torch.testing.assert_close(first, again, rtol=0, atol=0)
    torch.testing.assert_close(torch.random.get_rng_state(), state)


def test_seeds_epochs_and_names_each_make_another_stream():
    keys = list(itertools.product(range(30), range(30), ["lights", "batches", "dropout"]))
    seeds = {stream_seed(*key) for key in keys}
    assert len(seeds) == len(keys)
    assert all(0 <= seed < 2**63 for seed in seeds)
    assert max(seeds) > 2**62


def test_streams_of_neighbouring_epochs_are_uncorrelated():
    """Five standard errors of the correlation of 10,000 pairs."""
    draws = torch.stack([torch.rand(10_000, generator=generator(0, epoch, "lights")) for epoch in range(6)])
    correlation = torch.corrcoef(draws).fill_diagonal_(0)
    assert correlation.abs().max() < 5 / 100


def test_another_process_draws_the_same():
    """Whatever its hash seed, since a resumed run is another process."""
    script = "from augment.utils import stream_seed; print(stream_seed(1, 2, 'lights'))"
    environment = os.environ | {"PYTHONHASHSEED": "1", "PYTHONPATH": str(ROOT)}
    output = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True)
    assert int(output.stdout) == stream_seed(1, 2, "lights")
