"""Networks of transformers: loaded from a folder, they give what its own pipelines give."""

import json
import logging
import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import norm_balls as nb
from augment.classifier import as_network
from augment.huggingface import _read_preprocessor
from augment.network import ChannelNormalization
from renderer import InputError
from scripts.attack import main

transformers = pytest.importorskip("transformers")
pytestmark = [
    pytest.mark.ecosystem,
    pytest.mark.filterwarnings("ignore"),  # transformers warns of what it will change.
]

SIZE = 64
CLASSES = ["orange", "apple", "cup"]
LABELS = {"id2label": dict(enumerate(CLASSES)), "label2id": {c: i for i, c in enumerate(CLASSES)}}
SMALL = {"hidden_size": 32, "num_hidden_layers": 2, "num_attention_heads": 2}
SMALL |= {"intermediate_size": 48}
PATCHES = {"image_size": SIZE, "patch_size": 16}
STAGES = {"embed_dim": 16, "depths": [1, 1], "num_heads": [2, 2], "window_size": 4}
WIDTHS = {"hidden_sizes": [16, 24], "depths": [1, 1]}
TEXT = SMALL | {"vocab_size": 16, "max_position_embeddings": 64}
TEXT |= {"bos_token_id": 2, "eos_token_id": 3, "pad_token_id": 0}
TOWERS = {"text_config": TEXT, "vision_config": SMALL | PATCHES}
SQUARE = {"size": {"height": SIZE, "width": SIZE}}
CROPPED = {"crop_size": {"height": SIZE, "width": SIZE}}
# For each network: its class, its configuration, its image processor, and the pixels per side of an
# image that the processor crops to SIZE without interpolation.
CLASSIFIERS = {
    "vit": ("ViTForImageClassification", SMALL | PATCHES, "ViT", SQUARE, SIZE),
    "swin": (
        "SwinForImageClassification",
        STAGES | {"image_size": SIZE, "patch_size": 4},
        "ViT",
        SQUARE | {"image_mean": [0.485, 0.456, 0.406], "image_std": [0.229, 0.224, 0.225]},
        SIZE,
    ),
    "convnext": (
        *("ConvNextForImageClassification", WIDTHS | {"num_stages": 2}, "ConvNext"),
        *({"size": {"shortest_edge": SIZE}, "crop_pct": 0.5}, 2 * SIZE),
    ),
    "dinov2": (
        *("Dinov2ForImageClassification", SMALL | PATCHES, "Bit"),
        *({"size": {"shortest_edge": 80}} | CROPPED, 80),
    ),
    "mobilevit": (  # Blue is the first channel, and nothing is normalized.
        "MobileViTForImageClassification",
        {"hidden_sizes": [16, 24, 32], "neck_hidden_sizes": [8, 8, 8, 16, 16, 16, 32]}
        | {"image_size": SIZE, "num_attention_heads": 2},
        *("MobileViT", {"size": {"shortest_edge": SIZE}} | CROPPED, SIZE),
    ),
}
ZERO_SHOT = {
    "clip": (
        *("CLIPModel", TOWERS | {"projection_dim": 24}, "CLIP"),
        *({"size": {"shortest_edge": SIZE}} | CROPPED, SIZE),
    ),
    "siglip": ("SiglipModel", TOWERS, "Siglip", SQUARE, SIZE),
}
WITH_POSITIONS = {
    "detr": (
        "DetrForObjectDetection",
        {"d_model": 32, "encoder_layers": 1, "decoder_layers": 1, "num_queries": 5}
        | {"encoder_attention_heads": 2, "decoder_attention_heads": 2, "use_timm_backbone": False}
        | {"encoder_ffn_dim": 32, "decoder_ffn_dim": 32, "use_pretrained_backbone": False},
        *("Detr", {"size": {"shortest_edge": SIZE, "longest_edge": 96}}, SIZE),
    ),
    "segformer": (
        "SegformerForSemanticSegmentation",
        {"hidden_sizes": [8, 16, 16, 16], "depths": [1, 1, 1, 1], "decoder_hidden_size": 16},
        *("Segformer", SQUARE, SIZE),
    ),
    "mask2former": (
        "Mask2FormerForUniversalSegmentation",
        {"num_queries": 5, "hidden_dim": 32, "feature_size": 32, "mask_feature_size": 32}
        | {"encoder_layers": 1, "decoder_layers": 2, "num_attention_heads": 2}
        | {"dim_feedforward": 32, "encoder_feedforward_dim": 32},
        *("Mask2Former", SQUARE, SIZE),
    ),
}


@pytest.fixture
def save(tmp_path):
    """Function that saves a network with random weights and its processor, like a publisher."""

    def save(entry, with_processor=True):
        name, options, processor, prepared, _ = entry
        torch.manual_seed(0)
        kind = getattr(transformers, name)
        if "detr" in name.lower():
            last = {"embedding_size": 16, "out_features": ["stage2"]}
            options = options | {"backbone_config": transformers.ResNetConfig(**WIDTHS, **last)}
        if "Mask2" in name:
            stages = {"depths": [1] * 4, "num_heads": [2] * 4, "image_size": SIZE}
            stages |= {"out_features": [f"stage{index}" for index in range(1, 5)]}
            options = options | {"backbone_config": transformers.SwinConfig(**STAGES | stages)}
        network = kind(kind.config_class(**options, **({} if "Model" in name else LABELS))).eval()
        for parameter in network.parameters():  # Outputs of networks as initialized hardly differ.
            torch.nn.init.normal_(parameter, std=0.2) if parameter.ndim > 1 else None
        network.save_pretrained(tmp_path)
        if with_processor:
            made = getattr(transformers, f"{processor}ImageProcessor")(**prepared)
            made.save_pretrained(tmp_path)
        return str(tmp_path)

    return save


@pytest.fixture
def tokenizer(tmp_path):
    from tokenizers import Tokenizer, models, pre_tokenizers, processors

    words = ["<pad>", "<unk>", "<start>", "<end>", "a", "photo", "of", "the", *CLASSES]
    made = Tokenizer(models.WordLevel({word: i for i, word in enumerate(words)}, "<unk>"))
    made.pre_tokenizer = pre_tokenizers.Whitespace()
    made.post_processor = processors.TemplateProcessing(
        single="<start> $A <end>", special_tokens=[("<start>", 2), ("<end>", 3)]
    )
    special = {"pad_token": "<pad>", "unk_token": "<unk>", "eos_token": "<end>"}
    fast = transformers.PreTrainedTokenizerFast(
        tokenizer_object=made, bos_token="<start>", model_max_length=64, **special
    )
    fast.save_pretrained(tmp_path)


def photograph(size: int) -> Image.Image:
    return Image.fromarray(np.random.default_rng(0).integers(0, 256, (size, size, 3), np.uint8))


def as_images(picture: Image.Image) -> torch.Tensor:
    """Cut the center square of SIZE pixels, and return it as an image in [0, 1]."""
    begin = (picture.width - SIZE) // 2
    cut = np.asarray(picture)[begin : begin + SIZE, begin : begin + SIZE]
    return torch.from_numpy(cut.copy()).permute(2, 0, 1)[None] / 255


@pytest.mark.parametrize("name", CLASSIFIERS)
def test_a_classifier_gives_the_scores_of_the_pipeline_of_transformers(name, save, caplog):
    entry = CLASSIFIERS[name]
    folder = save(entry)
    caplog.set_level(logging.WARNING)
    classifier = nb.load_classifier(f"hf:{folder}")
    assert (classifier.size, list(classifier.classes)) == (SIZE, CLASSES)
    assert caplog.text.count("stated by preprocessor_config.json") == 3
    pipe = transformers.pipeline("image-classification", model=folder, device="cpu")
    picture = photograph(entry[-1])
    expected = {row["label"]: row["score"] for row in pipe(picture, top_k=3)}
    images = as_images(picture).requires_grad_()
    logits = classifier(images)
    scores = torch.tensor([expected[c] for c in CLASSES])
    torch.testing.assert_close(logits.softmax(1)[0].detach(), scores, atol=1e-4, rtol=0)
    (gradient,) = torch.autograd.grad(logits[0, 0], images)
    assert gradient.abs().max() > 0


@pytest.mark.parametrize("name", ZERO_SHOT)
def test_a_zero_shot_network_finds_classes_by_prompts_as_the_pipeline_does(name, save, tokenizer):
    folder = save(ZERO_SHOT[name])
    options = {"classes": CLASSES, "prompt": "photo of the {}"}
    classifier = nb.load_classifier(f"hf:{folder}", **options)
    pipe = transformers.pipeline("zero-shot-image-classification", model=folder, device="cpu")
    picture = photograph(SIZE)
    rows = pipe(picture, candidate_labels=CLASSES, hypothesis_template=options["prompt"])
    expected = torch.tensor([{r["label"]: r["score"] for r in rows}[c] for c in CLASSES])
    logits = classifier(as_images(picture))[0]
    scores = logits.sigmoid() if name == "siglip" else logits.softmax(0)
    torch.testing.assert_close(scores, expected, atol=1e-4, rtol=0)
    other = nb.load_classifier(f"hf:{folder}", classes=CLASSES)(as_images(picture))[0]
    assert (other - logits).abs().max() > 1e-3
    with pytest.raises(InputError, match="classes="):
        nb.load_classifier(f"hf:{folder}")


@pytest.mark.parametrize("name", ZERO_SHOT)
def test_the_command_of_the_guide_attacks_a_zero_shot_network(name, save, tokenizer, tmp_path):
    guide = (Path(nb.__file__).parents[1] / "docs/guide.md").read_text()
    [command] = re.findall("^pnb-attack (network=hf:.*)$", guide, re.MULTILINE)
    words = [f"network=hf:{save(ZERO_SHOT[name])}", *shlex.split(command)[1:]]
    fast = ["attack.force=true", "attack.max_steps=1", "attack.checks=false", "scene.views=1"]
    main.run(main.compose([*main.to_overrides(words), *fast, f"out={tmp_path / 'out'}"]))
    assert "images: 64 × 64 pixels" in (tmp_path / "out/config.yaml").read_text()
    assert len([*tmp_path.glob("out/*/attack.jsonl")]) == 1


@pytest.mark.parametrize("name", WITH_POSITIONS)
def test_a_detector_or_segmenter_finds_what_the_processor_of_transformers_reads(name, save):
    entry = WITH_POSITIONS[name]
    folder = save(entry)
    network = nb.load_classifier(f"hf:{folder}")
    assert (network.size, list(network.classes)) == (SIZE, CLASSES)
    picture = photograph(SIZE)
    processor = transformers.AutoImageProcessor.from_pretrained(folder)
    raw = getattr(transformers, entry[0]).from_pretrained(folder).eval()
    with torch.no_grad():
        expected = raw(**processor(images=picture, return_tensors="pt"))
        output = network(as_images(picture))[0]
    if name != "detr":
        read = processor.post_process_semantic_segmentation
        assert torch.equal(output.argmax(0), read(expected, target_sizes=[(SIZE, SIZE)])[0])
        return
    read = processor.post_process_object_detection
    (boxes,) = read(expected, threshold=0, target_sizes=[(SIZE, SIZE)])
    for key, values in boxes.items():
        torch.testing.assert_close(output[key], values, rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize("name", ZERO_SHOT)
def test_hardening_trains_the_texts_and_a_run_scores_the_same(
    name, save, tokenizer, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    save(ZERO_SHOT[name])
    (tmp_path / "photos").mkdir()
    for index in range(8):
        photograph(SIZE + index).save(tmp_path / "photos" / f"{index}.png")
    network = nb.load_classifier("hf:.", classes=CLASSES)
    options = {"train": {"epochs": 1}, "scene": {"views": 2}, "out": "run"}
    hardened = nb.harden(network, ["solid:orange"], "photos", **options)
    before = network.state_dict()
    changed = {key for key, value in hardened.state_dict().items() if (value != before[key]).any()}
    assert {key.rpartition(".text.")[1] for key in changed} == {".text."}
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    images = torch.rand(2, 3, SIZE, SIZE)
    torch.testing.assert_close(nb.load_run("../run")(images), hardened(images))


@pytest.mark.parametrize(
    ("kind", "options"),
    [
        ("EfficientNet", {"rescale_offset": True, "rescale_factor": 1 / 127.5}),
        ("MobileViT", {}),
        ("Siglip", {}),
        ("Beit", {"do_rescale": False}),
        ("Segformer", {"image_mean": [0.1, 0.2, 0.3], "image_std": [1, 2, 3]}),
    ],
)
def test_images_are_prepared_as_the_processor_states(kind, options, tmp_path):
    config = transformers.ViTConfig()
    config.save_pretrained(tmp_path)
    processor = getattr(transformers, f"{kind}ImageProcessor")(**options)
    processor.save_pretrained(tmp_path)
    folder = str(tmp_path)
    size, mean, std, is_bgr, *sources = _read_preprocessor(transformers, folder, config)
    picture = photograph(2 * size)
    expected = processor(images=picture, return_tensors="pt")["pixel_values"]
    plain = getattr(transformers, f"{kind}ImageProcessor")(
        **options
        | {"do_normalize": False, "do_rescale": True, "rescale_factor": 1 / 255}
        | {"rescale_offset": False, "include_top": False, "do_flip_channel_order": False}
    )
    images = plain(images=picture, return_tensors="pt")["pixel_values"]
    got = ChannelNormalization(mean, std, is_bgr)(images)
    torch.testing.assert_close(got, expected, rtol=1e-4, atol=1e-4 * float(expected.abs().max()))
    assert sources == ["preprocessor_config.json"] * 2


def test_without_a_processor_the_normalization_is_assumed(save, caplog):
    folder = save(CLASSIFIERS["vit"], with_processor=False)
    nb.load_classifier(f"hf:{folder}")
    assert f"{SIZE} × {SIZE} pixels, stated by the file" in caplog.text
    assert "std (0.5, 0.5, 0.5), assumed" in caplog.text


def test_a_processor_that_cuts_images_into_patches_is_refused(save):
    folder = save(("ViTForImageClassification", SMALL | PATCHES, "Siglip2", {}, SIZE))
    with pytest.raises(InputError, match="prepares no images"):
        nb.load_classifier(f"hf:{folder}")


def test_missing_weights_are_refused(save, tmp_path):
    import safetensors.torch

    folder = save(CLASSIFIERS["vit"])
    path = tmp_path / "model.safetensors"
    state = safetensors.torch.load_file(path)
    del state["classifier.weight"]
    safetensors.torch.save_file(state, path, {"format": "pt"})
    with pytest.raises(InputError, match=r"classifier\.weight"):
        nb.load_classifier(f"hf:{folder}")


def test_code_of_a_repository_is_not_run_even_if_the_user_would_agree(tmp_path, monkeypatch):
    code = {"AutoConfig": "code.Config", "AutoModelForImageClassification": "code.Network"}
    config = {"architectures": ["Network"], "model_type": "own", "auto_map": code}
    (tmp_path / "config.json").write_text(json.dumps(config))
    (tmp_path / "code.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')")
    monkeypatch.setattr("builtins.input", lambda *_: "y")
    with pytest.raises(InputError):
        nb.load_classifier(f"hf:{tmp_path}")
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize("name", ["detr", "segformer"])
def test_an_exported_network_is_loaded_in_a_program_that_has_not_imported_its_module(
    name, save, tmp_path
):
    folder = save(WITH_POSITIONS[name])
    network = getattr(transformers, WITH_POSITIONS[name][0]).from_pretrained(folder).eval()
    path, found = tmp_path / "network.pt2", tmp_path / "found.pt"
    images = torch.rand(1, 3, SIZE, SIZE, generator=torch.Generator().manual_seed(0))
    torch.export.save(torch.export.export(network, (images,)), path)
    code = f"""
import torch
import norm_balls as nb
network = nb.load_classifier({str(path)!r}, classes={CLASSES}, trust_code=True)
images = torch.rand(1, 3, {SIZE}, {SIZE}, generator=torch.Generator().manual_seed(0))
torch.save(network(images)[0], {str(found)!r})
"""
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(nb.__file__).parents[1])
    expected = as_network(network, SIZE, CLASSES)(images)[0]
    torch.testing.assert_close(torch.load(found), expected)
