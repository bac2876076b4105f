import pytest
import torch

from benchmarks import detectors


def test_the_box_of_fastestdet_starts_at_its_cell():
    raw = torch.zeros(1, 85, 22, 22)
    raw[0, 0, 3, 5], raw[0, 5 + 49, 3, 5] = 0.9, 0.8
    (found,) = detectors.decode(raw)
    # The offsets are tanh(0) = 0, and the size is σ(0) = 1/2 of the image.
    cell = 3 * 22 + 5
    x, y = 352 * 5 / 22, 352 * 3 / 22
    assert found["boxes"][cell].tolist() == pytest.approx([x - 88, y - 88, x + 88, y + 88])
    assert float(found["scores"][cell, 49]) == pytest.approx(0.9**0.6 * 0.8**0.4)
    assert found["scores"].argmax() == cell * 80 + 49


def test_the_part_of_hidden_views_is_over_all_detected_views_of_all_objects():
    assert detectors.fraction([(4, 4), (4, 0), (2, 1)]).value == 0.5
