"""Attacks on detectors and segmenters of other libraries, with random weights."""

from copy import deepcopy

import pytest
import torch
from torch import Tensor, nn
from torchvision.models import detection, segmentation
from torchvision.ops import box_iou

import norm_balls as nb
from augment.classifier import as_network
from augment.scene.truth import Truth
from augment.tasks.detection import CANDIDATE_SCORE, MAX_CANDIDATES
from tests.detectors import small_detector

SIZE = 64
CLASSES = ["background", "ball", "cup"]
UNTRAINED = {"weights": None, "weights_backbone": None, "num_classes": len(CLASSES)}
SMALL = {"min_size": SIZE, "max_size": SIZE}
RESNETS = ["retinanet_resnet50_fpn", "fcos_resnet50_fpn", "maskrcnn_resnet50_fpn"]
DETECTORS = dict.fromkeys([*RESNETS, "fasterrcnn_mobilenet_v3_large_320_fpn"], SMALL)
DETECTORS["ssdlite320_mobilenet_v3_large"] = {}
SEGMENTERS = ["lraspp_mobilenet_v3_large", "fcn_resnet50", "deeplabv3_mobilenet_v3_large"]


def cost_falls(network: nn.Module, task: nb.Detection | nb.Segmentation, **options) -> bool:
    """Return whether a step of an attack on light lowers the cost of a network."""
    scene = nb.build_scene([("solid:ball", "ball")], size=SIZE, width=2.5)
    settings = nb.AttackSettings(lighting=nb.StepSettings(step_size=0.3), max_steps=1, margin=100.0)
    given = {"task": task, "settings": settings, "force": True}
    found = nb.attack(network, scene, **given, **options).minimum
    return bool((found.cost < found.cost_before).all())


def of_torchvision(library, name: str, **options) -> nn.Module:
    """Return an untrained network whose activations neither vanish nor explode."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        network = getattr(library, name)(**UNTRAINED, **options)
        for part in network.modules():
            if isinstance(part, nn.BatchNorm2d):
                part.momentum = 1.0
        network.backbone(torch.randn(4, 3, 2 * SIZE, 2 * SIZE))
    return network.eval()


def test_the_number_of_classes_is_not_that_of_a_backbone():
    network = of_torchvision(detection, "fasterrcnn_mobilenet_v3_large_320_fpn", **SMALL)
    network.backbone.num_classes = 1000
    names = ["background", "ball", "cup"]
    assert as_network(network, SIZE, names).classes == tuple(names)


def require_slope(network, task, step: float = 1e-7, rtol: float = 1e-3) -> None:
    """Compare the slope of the cost along its gradient in pixels with that by finite differences.

    The object is at a candidate of a detector, or in the center for a segmenter. Steps are small,
    because deep networks have many kinks.
    """
    adapted = as_network(network.double(), SIZE, CLASSES, dtype=torch.float64)
    draws = torch.Generator().manual_seed(1)
    images = torch.rand(1, 3, SIZE, SIZE, generator=draws, dtype=torch.float64)
    shown = images.clone().requires_grad_()
    found = adapted(shown)
    box = torch.tensor([16.0, 16.0, 48.0, 48.0], dtype=torch.float64)
    if isinstance(task, nb.Detection):
        candidates = found[0]["candidate_boxes"].detach()
        box = candidates[box_iou(candidates, box[None])[:, 0].argmax()]
    masks = torch.zeros(1, 1, 1, SIZE, SIZE, dtype=torch.bool)
    masks[..., 16:48, 16:48] = True
    truth = Truth(torch.ones(1, 1, 1).long(), box.view(1, 1, 1, 4), masks, torch.ones(1, 1, 1))
    rule = task.criterion(torch.tensor([[1]]), lambda: truth, len(CLASSES))
    rule = rule.map(lambda rows: rows.flatten(0, 1))
    (gradient,) = torch.autograd.grad(rule.cost(found).sum(), shown)
    slope = gradient.norm()
    with torch.no_grad():
        ahead, behind = (
            rule.cost(adapted(images + sign * step * gradient / slope)) for sign in (1, -1)
        )
    assert slope > 1e-8
    torch.testing.assert_close(slope, (ahead - behind).sum() / (2 * step), rtol=rtol, atol=0)


@pytest.mark.slow
@pytest.mark.parametrize("goal", ["hide", "mislabel"])
@pytest.mark.parametrize("name", DETECTORS)
def test_the_gradient_of_a_detector_of_torchvision_is_that_of_finite_differences(name, goal):
    network = of_torchvision(detection, name, **DETECTORS[name])
    # Detectors with proposals give no gradient to the positions of the proposals.
    require_slope(network, nb.Detection(goal=goal), rtol=0.1 if "rcnn" in name else 1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("name", SEGMENTERS)
def test_the_gradient_of_a_segmenter_of_torchvision_is_that_of_finite_differences(name):
    require_slope(of_torchvision(segmentation, name), nb.Segmentation())


WRAPPERS = {
    "plain": lambda network: network,
    "DataParallel": lambda network: torch.nn.DataParallel(network).eval(),
    "compiled": lambda network: torch.compile(network, backend="eager"),
}


@pytest.mark.parametrize("wrap", WRAPPERS.values(), ids=WRAPPERS)
def test_candidates_of_torchvision_are_its_boxes_without_suppression_in_the_pixels_given(wrap):
    network = small_detector(len(CLASSES), SIZE)
    images = torch.rand(2, 3, 48, 96, generator=torch.Generator().manual_seed(0))
    opened = deepcopy(network)
    limits = {"score_thresh": CANDIDATE_SCORE, "detections_per_img": MAX_CANDIDATES}
    vars(opened).update(limits, nms_thresh=1.0)
    with torch.no_grad():
        own, expected = network(images), opened(images)
        found = as_network(wrap(network), (48, 96), CLASSES)(images)
    for item, final, candidates in zip(found, own, expected, strict=True):
        assert len(candidates["boxes"]) > len(final["boxes"])
        for key in ("boxes", "scores", "labels"):
            assert torch.equal(item[key], final[key])
            torch.testing.assert_close(item[f"candidate_{key}"], candidates[key])
    assert "postprocess_detections" not in vars(network)


@pytest.mark.parametrize("goal", ["hide", "mislabel"])
def test_the_gradient_in_the_pixels_is_that_of_finite_differences(goal):
    require_slope(small_detector(len(CLASSES), SIZE), nb.Detection(goal=goal), step=1e-4)


def test_a_single_logit_of_a_detector_of_transformers_is_that_of_its_class():
    def find(images: Tensor) -> dict[str, Tensor]:
        logits = images.mean((1, 2, 3))[:, None, None]
        return {"logits": logits, "pred_boxes": torch.full((len(images), 1, 4), 0.5)}

    images = torch.full((2, 3, SIZE, SIZE), 0.25)
    for item in as_network(find, SIZE, ["ball"])(images):
        torch.testing.assert_close(item["scores"], torch.tensor([0.25]).sigmoid())
        assert item["labels"].tolist() == [0]


def test_boxes_of_rt_detr_are_those_of_the_last_layer_in_pixels():
    boxes = torch.tensor([[1.0, 1.0, 1.0, 1.0], [0.5, 0.4, 0.2, 0.6]])[:, None, None]
    logits = torch.tensor([[9.0, 9.0, 9.0], [-1.0, 2.0, -3.0]])[:, None, None]
    outputs = torch.zeros(1, 1, 6), (boxes, logits, None, None, None)
    [item] = nb.Detection().reader("network", 3)(outputs, torch.zeros(1, 3, 50, 100))
    torch.testing.assert_close(item["boxes"], torch.tensor([[40.0, 5.0, 60.0, 35.0]]))
    assert item["labels"].tolist() == [1]
    torch.testing.assert_close(item["candidate_scores"], logits[1, 0].sigmoid())


class Raw(nn.Module):
    """Returns the means of 4 × 4 fields in each class, as scores, and one box for each field."""

    def __init__(self):
        super().__init__()
        with torch.random.fork_rng():
            torch.manual_seed(0)
            self.score = nn.Conv2d(3, len(CLASSES), 16, stride=16)

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        scores = self.score(images).sigmoid()
        return scores.flatten(2).transpose(1, 2), scores[:, :1].flatten(1)


def decode(outputs: tuple[Tensor, Tensor]) -> list[dict[str, Tensor]]:
    """Give every second field a box that covers the ball, and the others small boxes."""
    boxes = torch.tensor([[8.0, 8.0, 56.0, 56.0], [0.0, 0.0, 8.0, 8.0]]).repeat(8, 1)
    return [{"boxes": boxes, "scores": scores} for scores in outputs[0]]


@pytest.mark.ecosystem
@pytest.mark.parametrize("batch", ["fixed", "any"])
@pytest.mark.filterwarnings("ignore")
def test_a_file_of_onnx_with_decode_has_the_gradients_of_its_network(tmp_path, batch):
    pytest.importorskip("onnx2torch")
    path = tmp_path / "network.onnx"
    network = Raw().eval()
    names = {"input_names": ["images"], "output_names": ["scores", "first"]}
    if batch == "any":
        names["dynamic_axes"] = {key: {0: "N"} for key in ("images", "scores", "first")}
    torch.onnx.export(
        network, (torch.rand(1, 3, SIZE, SIZE),), path, dynamo=False, opset_version=13, **names
    )
    task = nb.Detection(decode=decode)
    loaded = nb.load_classifier(str(path), classes=CLASSES, task=task)
    shown = [torch.rand(3, 3, SIZE, SIZE).requires_grad_()]
    shown.append(shown[0].detach().clone().requires_grad_())
    plain = as_network(network, SIZE, CLASSES, task=task)
    for images, one in zip(shown, (loaded, plain), strict=True):
        sum(item["candidate_scores"].sum() for item in one(images)).backward()
    torch.testing.assert_close(shown[0].grad, shown[1].grad)
    assert cost_falls(loaded, task)


LABELS = {"id2label": dict(enumerate(CLASSES)), "label2id": {"ball": 1, "cup": 2}}
QUERIES = {"num_queries": 20, "d_model": 32, "encoder_layers": 1, "decoder_layers": 1}
BACKBONE = {"embedding_size": 8, "hidden_sizes": [8, 16, 24, 32], "depths": [1, 1, 1, 1]}


@pytest.mark.ecosystem
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("goal", ["hide", "mislabel"])
@pytest.mark.parametrize("kind", ["Detr", "ConditionalDetr", "Yolos"])
def test_an_attack_lowers_the_cost_of_a_detector_of_transformers(kind, goal):
    transformers = pytest.importorskip("transformers")
    if kind == "Yolos":
        vit = {"hidden_size": 32, "num_hidden_layers": 2, "num_attention_heads": 2}
        options = vit | {"image_size": [SIZE, SIZE], "num_detection_tokens": 20}
    else:
        backbone = transformers.ResNetConfig(**BACKBONE, out_features=["stage4"])
        options = QUERIES | {"use_timm_backbone": False, "backbone": None}
        options |= {"use_pretrained_backbone": False, "backbone_config": backbone}
    config = getattr(transformers, f"{kind}Config")(**options, **LABELS)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        network = getattr(transformers, f"{kind}ForObjectDetection")(config).eval()
    # Random boxes are small and near the center.
    assert cost_falls(network, nb.Detection(goal=goal, iou=0.02))


@pytest.mark.ecosystem
@pytest.mark.filterwarnings("ignore")
def test_an_attack_lowers_the_cost_of_segformer():
    transformers = pytest.importorskip("transformers")
    small = {"hidden_sizes": [8, 16, 24, 32], "depths": [1] * 4, "num_attention_heads": [1] * 4}
    config = transformers.SegformerConfig(**small, **LABELS, decoder_hidden_size=16)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        network = transformers.SegformerForSemanticSegmentation(config).eval()
    assert cost_falls(network, nb.Segmentation())


@pytest.mark.ecosystem
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", ["yolov8n", "yolo11n", "yolov10n"])
@pytest.mark.parametrize("is_wrapped", [True, False])
def test_a_model_of_ultralytics_is_read_and_attacked(name, is_wrapped):
    ultralytics = pytest.importorskip("ultralytics")
    with torch.random.fork_rng():
        torch.manual_seed(0)
        yolo = ultralytics.YOLO(f"{name}.yaml")
    network = yolo if is_wrapped else yolo.model.eval()
    adapted = as_network(network, SIZE)
    assert len(adapted.classes) == 80
    images = torch.rand(2, 3, SIZE, SIZE)
    raw = yolo.model(images)[0]
    for item, columns in zip(adapted(images), raw, strict=True):
        x, y, width, height = columns[:4]
        sides = torch.stack([x - width / 2, y - height / 2, x + width / 2, y + height / 2], 1)
        torch.testing.assert_close(item["candidate_boxes"], sides)
        torch.testing.assert_close(item["candidate_scores"], columns[4:].mT)
    # Scores of random weights hardly change with light, but have a gradient.
    shown = images.requires_grad_()
    (gradient,) = torch.autograd.grad(adapted(shown)[0]["candidate_scores"].sum(), shown)
    assert gradient[0].any() and not gradient[1].any()
