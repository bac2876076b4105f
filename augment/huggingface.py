"""Networks of Hugging Face's transformers, by the name of their folder or of their repository.

Classifiers give logits, and zero-shot networks such as CLIP classify by prompts. Detectors and
segmenters give the output of transformers, which a task reads.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from PIL import Image
from torch import Tensor, nn

from augment.classifier import IMAGENET, USUAL_SIZE, TaskNetwork, as_network, mean_and_std
from augment.files import NetworkFacts, import_package, name_error, reading_network
from augment.network import FILE, ChannelNormalization, Network
from renderer.errors import InputError
from renderer.settings import Size, as_size, height_and_width

# Default prompt of a zero-shot network, in which {} stands for the name of a class.
PROMPT = "a photo of a {}"
# Pixels per side of two images that are prepared to find out to which size.
PROBED = (600, 300)
# Logits of a zero-shot network may differ by this much from those of transformers.
TOLERANCE = 1e-3
# A repository may have Python code of its own, about which transformers would ask on the terminal.
NO_CODE = {"trust_remote_code": False}
# Tasks of transformers whose models the library reads.
_TASKS = (
    *("IMAGE_CLASSIFICATION", "OBJECT_DETECTION", "IMAGE_SEGMENTATION"),
    *("SEMANTIC_SEGMENTATION", "INSTANCE_SEGMENTATION", "UNIVERSAL_SEGMENTATION"),
)


class ZeroShot(nn.Module):
    """Classifier by texts: logits are the scaled cosines of an image and the prompt of each class.

    Attributes:
        model: Model of transformers without its text encoder.
        text: Last layer. Its weights are the vectors of the prompts, times the scale of the model.
    """

    def __init__(self, model: Any, class_count: int, dimension: int):
        super().__init__()
        has_bias = getattr(model, "logit_bias", None) is not None
        model.text_model = None
        self.model = model
        self.text = nn.Linear(dimension, class_count, bias=has_bias)

    def forward(self, images: Float[Tensor, "N 3 H W"]) -> Float[Tensor, "N C"]:
        """Compute the logits of normalized images."""
        features = self.model.get_image_features(pixel_values=images)
        # The method returned the vectors themselves before version 5.
        return self.text(F.normalize(getattr(features, "pooler_output", features), dim=-1))


def load(model: str, _: Path | None, facts: NetworkFacts, is_random: bool) -> TaskNetwork:
    """Load or build a network of transformers: a folder, or a repository of the Hub."""
    name = f"hf:{model}"
    library = import_package("transformers", name, '"parametric-norm-balls[hf]"')
    advice = "give a folder that save_pretrained wrote, or a repository of the Hugging Face Hub"
    with reading_network(name, "cannot be read", advice):
        config = library.AutoConfig.from_pretrained(model, **NO_CODE)
    # Name of the class of the network, by which its task is known.
    architecture = (config.architectures or [""])[0]
    auto = library.models.auto.modeling_auto
    zero_shot = auto.MODEL_FOR_ZERO_SHOT_IMAGE_CLASSIFICATION_MAPPING_NAMES.values()
    is_zero_shot = architecture in zero_shot
    if not is_zero_shot and architecture not in _architectures(auto):
        kinds = "image classification, zero-shot classification, detection or segmentation"
        found = architecture or config.model_type
        raise name_error(name, f"is {found}: give a network for {kinds}")
    if is_zero_shot and not facts.classes:
        raise name_error(name, f"finds classes by their names: set classes=, and prompt='{PROMPT}'")
    if facts.prompt is not None and (not is_zero_shot or "{}" not in facts.prompt):
        reason = "lacks {} for the class" if is_zero_shot else f"is not for {name}, which has names"
        advice = f"give '{PROMPT}', or leave it out"
        raise InputError(f"prompt={facts.prompt} {reason}: {advice}", "prompt")

    network = _model(getattr(library, architecture), model, config, name, is_random)
    # What the user gives replaces what the files state.
    size, mean, std, is_bgr, *sources = _read_preprocessor(library, model, config)
    size = facts.size or size
    if facts.normalization is not None:
        mean, std = mean_and_std(facts.normalization)
    normalization = ChannelNormalization(mean, std, is_bgr)
    if is_zero_shot:
        gray = normalization(torch.full((1, 3, *height_and_width(size)), 0.5))
        network = _zero_shot(library, network, model, facts, gray, is_random)
    normalized = Network(network.eval(), [normalization])
    made = as_network(normalized, size, facts.classes, name=name, says=False)
    made.inputs = facts.inputs(*sources)
    return made


def _architectures(auto: Any) -> set[str]:
    """Return the names of the classes of transformers for `_TASKS`."""
    mappings = [getattr(auto, f"MODEL_FOR_{task}_MAPPING_NAMES").values() for task in _TASKS]
    entries = [entry for mapping in mappings for entry in mapping]
    return {name for entry in entries for name in ([entry] if isinstance(entry, str) else entry)}


def _model(kind: Any, model: str, config: Any, name: str, is_random: bool) -> Any:
    """Load a model of transformers in single precision, or build it with random weights."""
    if is_random:
        return kind._from_config(config)
    with reading_network(name, "cannot be loaded", "check the files of its weights"):
        loaded, report = kind.from_pretrained(model, output_loading_info=True, **NO_CODE)
    if missing := sorted(report["missing_keys"]):
        reason = f"lacks weights, such as {missing[0]}"
        raise name_error(name, f"{reason}: give a trained {kind.__name__}")
    return loaded.float()


def _read_preprocessor(
    library: Any, model: str, config: Any
) -> tuple[Size, Sequence[float], Sequence[float], bool, str | None, str | None]:
    """Find out how the images of a network are prepared, and who states it.

    Return the size, mean and standard deviation in units of [0, 1], whether blue is the first
    channel, and who states the size and the normalization. Images of one color are prepared, so
    that rescaling, shifts and the order of the channels count, however the processor defines them.
    """
    try:
        processor: Any = library.AutoImageProcessor.from_pretrained(model, **NO_CODE)
        # This file states how the images of a network are prepared.
        source: str | None = "preprocessor_config.json"
    except (OSError, ValueError):
        # Without a file, the default processor of the kind of the model counts, if there is one.
        mapping = library.models.auto.image_processing_auto.IMAGE_PROCESSOR_MAPPING
        kinds = mapping.get(type(config), {})
        kind = next(iter(kinds.values()), None) if isinstance(kinds, dict) else None
        processor, source = None if kind is None else kind(), None

    def prepare(color: Sequence[int], side: int) -> Tensor:
        image = Image.fromarray(np.full((side, side, 3), color, np.uint8))
        return processor(images=image, return_tensors="pt")["pixel_values"][0]

    # Networks of images and texts have a configuration of their vision part.
    of_config = getattr(getattr(config, "vision_config", config), "image_size", None)
    # A list is (height, width).
    is_stated = isinstance(of_config, int | list | tuple)
    size: Size = as_size("size", of_config) if is_stated else USUAL_SIZE
    sizer = FILE if is_stated else None
    if processor is None:
        return size, *mean_and_std(IMAGENET), False, sizer, None
    # Images of two sizes become images of one size if the processor resizes to a fixed size.
    shapes = {tuple(prepare((0, 0, 0), side).shape) for side in PROBED}
    if any(len(shape) != 3 for shape in shapes):
        raise name_error(f"hf:{model}", "prepares no images of three axes: use another network")
    if source and len(shapes) == 1:
        _, height, width = shapes.pop()
        size, sizer = height if height == width else (height, width), source
    # The values of black, and of pure red, green and blue, tell the linear map of each channel.
    colors = [prepare(color, PROBED[1]) for color in ((0, 0, 0), *np.eye(3, dtype=int) * 255)]
    black, *gains = (one[:, one.shape[1] // 2, one.shape[2] // 2].double() for one in colors)
    # Rows are channels of the network, and columns are red, green and blue.
    gain = torch.stack(gains, 1) - black[:, None]
    is_bgr = bool(gain[0, 2].abs() > gain[0, 0].abs())
    # The value x of a channel becomes gain · x + black, which is (x − mean) / std.
    own_gain = (gain.flip(1) if is_bgr else gain).diagonal()
    mean, std = (-black / own_gain).tolist(), (1 / own_gain).tolist()
    return size, mean, std, is_bgr, sizer, source


@torch.no_grad()
def _zero_shot(
    library: Any, model: Any, name: str, facts: NetworkFacts, gray: Tensor, is_random: bool
) -> ZeroShot:
    """Make a classifier of a model with an image and a text encoder, and check it on an image."""
    classes = facts.classes or ()
    if is_random:
        # The features of an image tell the number of inputs of the last layer.
        features = model.eval().get_image_features(pixel_values=gray)
        return ZeroShot(model, len(classes), getattr(features, "pooler_output", features).shape[-1])
    prompts = [(facts.prompt or PROMPT).replace("{}", label) for label in classes]
    # SigLIP was trained with texts of one length.
    options: dict[str, Any] = {"padding": True}
    if "siglip" in model.config.model_type:
        options = {"padding": "max_length", "max_length": 64, "truncation": True}
    # Its tokenizer may lack files, or the model may be of another kind.
    with reading_network(f"hf:{name}", "is no zero-shot network like CLIP", "use another network"):
        tokenizer = library.AutoTokenizer.from_pretrained(name, **NO_CODE)
        tokens = tokenizer(prompts, return_tensors="pt", **options)
        output = model.eval()(pixel_values=gray, **tokens)
        # Unit vectors of the prompts, times the scale of the model, shape (C, D).
        vectors = F.normalize(output.text_embeds, dim=-1) * model.logit_scale.exp()
        network = ZeroShot(model, *vectors.shape)
    network.text.weight.copy_(vectors)
    if network.text.bias is not None:
        network.text.bias.fill_(model.logit_bias.item())
    if not torch.allclose(network(gray), output.logits_per_image, rtol=TOLERANCE, atol=TOLERANCE):
        raise name_error(f"hf:{name}", "has logits other than scaled cosines: use another network")
    return network
