import colorsys

import torch

from augment.camera_effects import draw_patterns
from augment.utils import generator
from renderer.image import encode

PATTERNS = draw_patterns(200, 24, generator(0))


def colours(pattern: torch.Tensor) -> torch.Tensor:
    return pattern.flatten(1).T.unique(dim=0)


def test_a_pattern_is_of_at_most_two_colours_and_its_brighter_one_is_full():
    assert PATTERNS.shape == (200, 3, 24, 24) and PATTERNS.min() >= 0
    assert {len(colours(pattern)) for pattern in PATTERNS} == {1, 2}
    brightest = torch.stack([colours(pattern).amax() for pattern in PATTERNS])
    assert (brightest <= 1).all() and (brightest == 1).double().mean() > 0.9  # a half may leave the bright side out


def test_a_quarter_is_plain_and_hues_and_saturations_take_the_whole_range():
    plain = [colours(pattern)[0] for pattern in PATTERNS if len(colours(pattern)) == 1]
    assert 0.15 < len(plain) / len(PATTERNS) < 0.4
    hsv = torch.tensor([colorsys.rgb_to_hsv(*encode(colour, "srgb").tolist()) for colour in plain])
    assert torch.histc(hsv[:, 0], 3, 0, 1).min() > 5 and hsv[:, 1].min() < 0.2 and hsv[:, 1].max() > 0.8


def test_the_generator_decides_the_draw():
    assert torch.equal(draw_patterns(200, 24, generator(0)), PATTERNS)
    assert not torch.equal(draw_patterns(200, 24, generator(1)), PATTERNS)
