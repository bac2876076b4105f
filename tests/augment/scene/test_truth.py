"""The truth of the images of a scene: masks, boxes and visible fractions."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

import norm_balls as nb
from augment.scene.truth import NO_OBJECT
from renderer.mesh import select_faces
from train.class_names import as_mappings, with_class_name
from train.settings import read_objects


def test_the_mask_of_a_ball_is_its_disc_and_the_box_contains_the_mask():
    scene = nb.build_scene([("solid:ball", "ball")], size=32, views=2, width=3.0, samples=8)
    truth = scene.truth({"ball": 7}.__getitem__)
    assert truth.labels.tolist() == [[[7]], [[7]]]
    for view in range(2):
        mask = truth.masks[view, 0, 0]
        rows, columns = mask.nonzero().T
        left, top, right, bottom = truth.boxes[view, 0, 0].tolist()
        assert (left, right) == (columns.min(), columns.max() + 1)
        assert (top, bottom) == (rows.min(), rows.max() + 1)
        # A disc of radius 1: half of a pixel must be covered.
        assert abs(mask.sum() / (math.pi * (32 / 3) ** 2) - 1) < 0.02
    assert truth.visible.eq(1).all()


def test_boxes_and_fractions_of_two_balls_are_those_of_overlapping_discs():
    """Seen from +x, a disc of radius 1 hides its area of one of radius 1.5 on the same ground."""
    balls = [("solid:ball", 3), nb.ObjectSettings("solid:ball", "big", at=[-2.6, 0.0], scale=1.5)]
    scene = nb.build_scene([balls], 128, width=6.0, polar=90.0, samples=4)
    truth = scene.truth(lambda label: 5 if label == "big" else label)
    assert truth.labels.tolist() == [[[3, 5]]]
    assert truth.visible[0, 0].tolist() == [1.0, pytest.approx(1 - 1 / 1.5**2, abs=0.01)]
    pixel = 128 / 6
    expected = [64 - 1.5 * pixel, 64 - 2 * pixel, 64 + 1.5 * pixel, 64 + 1 * pixel]
    assert truth.boxes[0, 0, 1].tolist() == pytest.approx(expected, abs=2)
    # Pixels of which both cover exactly half belong to the first.
    assert not (truth.masks[0, 0, 0] & truth.masks[0, 0, 1]).any()


def test_a_mask_is_that_of_the_object_alone_without_what_others_hide():
    cup = nb.ObjectSettings("solid:cup", "cup", at=[-1.2, 0.3], scale=0.9, azimuth=40.0)
    meshes = [[("solid:pear", "pear"), cup, ("solid:lemon", "")]]
    scene = nb.build_scene(meshes, (64, 96), width=6.0, fov=30.0, samples=1)
    truth = scene.truth(["pear", "cup"].index)
    assert truth.labels.tolist() == [[[0, 1]]]  # The lemon has no class.
    item = scene.objects[0]
    starts = [0, *item.ends]
    alone = []
    for start, end in itertools.pairwise(starts):
        mesh = select_faces(item.mesh, slice(start, end))
        image = nb.render(mesh, scene.cameras[0][0], None, (64, 96), 1.0, samples=1)
        alone.append(image[0] < 1)
    pear, cup, lemon = alone
    assert torch.equal(truth.masks[0, 0, 0], pear)
    assert (pear & cup).any()
    assert torch.equal(truth.masks[0, 0, 1], cup & ~pear & ~lemon)
    assert truth.visible[0, 0, 1].item() == pytest.approx(
        ((cup & ~pear & ~lemon).sum() / cup.sum()).item(), abs=1e-6
    )


def test_a_hidden_object_and_one_outside_of_the_view_are_left_out_and_said(caplog):
    behind = nb.ObjectSettings("solid:ball", "hidden", at=[-2.0, 0.0], scale=0.5)
    outside = nb.ObjectSettings("solid:ball", "outside", at=[0.0, 8.0])
    scene = nb.build_scene([[("solid:ball", "ball"), behind, outside]], 32, polar=90.0)
    truth = scene.truth(["ball", "hidden", "outside"].index)
    assert truth.labels.tolist() == [[[0, NO_OBJECT, NO_OBJECT]]]
    assert not truth.masks[0, 0, 1:].any()
    assert truth.boxes[0, 0, 1:].eq(0).all()
    assert "left out of the truth of views" in caplog.text


@pytest.mark.parametrize("visible", [0.08, 0.12])
def test_an_object_of_which_a_tenth_is_visible_is_labeled(visible):
    """Seen from +x, the disc of a ball of radius 1 lies in that of a larger one behind it."""
    radius = (1 - visible) ** -0.5
    behind = nb.ObjectSettings("solid:ball", "behind", at=[-3.0, 0.0], scale=radius)
    scene = nb.build_scene([[("solid:ball", "ball"), behind]], 64, width=4.0, polar=90.0, samples=4)
    truth = scene.truth(["ball", "behind"].index)
    assert truth.visible[0, 0, 1].item() == pytest.approx(visible, abs=0.01)
    assert truth.labels[0, 0, 1] == (1 if visible > 0.1 else NO_OBJECT)


def test_objects_without_a_position_do_not_touch_and_stand_on_one_ground():
    kinds = ["pear", "cup", "ball", "table", "orange"]
    scene = nb.build_scene([[(f"solid:{kind}", kind) for kind in kinds]], 8)
    item = scene.objects[0]
    parts = [
        item.mesh.vertices[item.mesh.faces[a:b]] for a, b in itertools.pairwise([0, *item.ends])
    ]
    assert np.ptp([part[..., 2].min() for part in parts]) < 1e-6
    spans = sorted((part[..., 1].min(), part[..., 1].max()) for part in parts)
    assert all(after[0] - before[1] > 0.1 for before, after in itertools.pairwise(spans))


def test_a_list_of_objects_in_settings_and_arguments_is_one_entry():
    cup = nb.ObjectSettings("solid:cup", "cup", at=[1.0, 2.0])
    arguments = as_mappings("meshes", [[("solid:pear", 0), replace(cup, label=1)], "solid:pear"])
    mappings = [with_class_name(item, ["pear", "cup", "lemon"], "meshes") for item in arguments]
    written = ["solid:pear", {"mesh": "solid:cup", "label": "cup", "at": [1.0, 2.0]}]
    for given in (mappings, [written, "solid:pear"]):
        read = read_objects(given, "pear", "meshes")
        assert read["meshes[0]"] == nb.ObjectSettings("solid:pear", "pear", others=[cup])
        assert read["meshes[1]"] == nb.ObjectSettings("solid:pear", "pear")


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ([("solid:pear", "pear"), "solid:cup"], r"^meshes\[0\]\[1\] is 'solid:cup': give a pair"),
        ([nb.ObjectSettings("solid:pear", at=[1.0, 0.0]), ("solid:cup", 1)], r"^at=\[1\.0, 0\.0\]"),
        (nb.ObjectSettings("solid:pear", "pear", scale=2.0), r"^at=None and scale=2\.0"),
        ([("solid:pear", "pear"), ("solid:cup", 1.5)], r"^meshes\[0\]\[1\]: its label"),
        ([], r"^meshes\[0\] is "),
    ],
)
def test_a_wrong_list_of_objects_is_refused_in_one_sentence(entry, message):
    with pytest.raises(nb.InputError, match=message):
        nb.build_scene([entry], 8)
