"""The truth of the images of a scene: masks, boxes and visible fractions."""

import math

import torch

import norm_balls as nb
from augment.scene.truth import boxes_of


def test_the_mask_of_a_ball_is_its_disc_and_the_box_contains_the_mask():
    scene = nb.build_scene([("solid:ball", "ball")], size=64, views=2)
    truth = scene.truth({"ball": 7}.__getitem__)
    assert truth.labels.tolist() == [[[7]], [[7]]]
    for view in range(2):
        mask = truth.masks[view, 0, 0]
        rows, columns = mask.nonzero().T
        left, top, right, bottom = truth.boxes[view, 0, 0].tolist()
        assert (left, right) == (columns.min(), columns.max() + 1)
        assert (top, bottom) == (rows.min(), rows.max() + 1)
        # The area of a disc of the width of the box, to the discretization of its border.
        assert abs(mask.sum() / (math.pi / 4 * (right - left) * (bottom - top)) - 1) < 0.02
    assert truth.visible.eq(1).all()


def test_the_box_of_an_empty_mask_is_zero():
    assert boxes_of(torch.zeros(2, 5, 4, dtype=torch.bool)).tolist() == [[0.0] * 4] * 2
