import json
import math
import pickle
from collections import UserDict
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from PIL import Image
from scipy import integrate, spatial, stats
from torch.utils.data import DataLoader
from torchvision import tv_tensors

import norm_balls as nb
from augment import lighting
from augment.scene import lights, loops, patterns, surfaces
from augment.scene.lights import MODELS, Illumination
from augment.scene.surfaces import circle_segment
from renderer.image import decode, encode

DTYPES = [torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64, torch.uint16]
DTYPES += [torch.float16, torch.bfloat16, torch.float32, torch.float64]


def picture(*shape: int, seed: int = 0) -> torch.Tensor:
    draws = torch.Generator().manual_seed(seed)
    return torch.randint(0, 256, shape, generator=draws, dtype=torch.uint8)


def draw_values(model: lights.LightModel, count: int = 1, seed: int = 0) -> torch.Tensor:
    draws = torch.Generator().manual_seed(seed)
    return torch.rand(count, model.dimensions + model.constants, generator=draws)


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize(("channels", "size"), [(1, (1, 1)), (2, (5, 8)), (3, (1, 7)), (4, (9, 1))])
def test_each_model_keeps_dtype_shape_and_alpha(name, channels, size):
    torch.manual_seed(0)
    image = picture(channels, *size)
    relit = nb.RandomLighting(name)(image)
    assert relit.dtype == image.dtype and relit.shape == image.shape
    if channels in (2, 4):
        assert torch.equal(relit[-1], image[-1])


@pytest.mark.parametrize(
    ("name", "dtype"),
    [
        *((name, dtype) for name in MODELS for dtype in (torch.uint8, torch.float16)),
        *(("linear", dtype) for dtype in DTYPES[1:] if dtype != torch.float16),
    ],
    ids=str,
)
def test_every_dtype_agrees_with_double_precision(name, dtype):
    model = MODELS[name]()
    light = lighting.Light(model, draw_values(model)[0], 3, 1.0)
    unit = picture(3, 6, 6).double() / 255
    largest = 1 if dtype.is_floating_point else torch.iinfo(dtype).max
    exact = lighting.RandomLighting().apply(unit, {"lights": [light]})
    given = (unit * largest).clamp(max=largest - largest // 1000).to(dtype)
    relit = lighting.RandomLighting().apply(given, {"lights": [light]})
    assert relit.dtype == dtype
    error = (relit.double() / largest - exact).abs().max()
    # The noise of low light turns rounding errors to steps of whole electrons.
    assert error < (0.15 if name == "low_light" else 0.02)


@pytest.mark.parametrize("mode", ["1", "L", "LA", "P", "PA", "RGB", "RGBA", "CMYK", "HSV", "YCbCr"])
def test_pil_images_keep_mode_and_size(mode):
    image = Image.fromarray(picture(5, 8, 4).numpy()).convert(mode)
    relit = nb.RandomLighting("linear")(image)
    assert relit.mode == mode and relit.size == image.size


@pytest.mark.parametrize("mode", ["I;16", "I"])
def test_pil_images_of_16_bits_are_relit_in_their_range(mode):
    values = torch.randint(0, 2**16, (4, 6)).to(torch.uint16)
    light = (transform := nb.RandomLighting("linear")).make_params()
    expected = transform.apply(values, light)
    image = Image.fromarray(values.numpy().astype({"I;16": np.uint16, "I": np.int32}[mode]))
    relit = transform.apply(image, light)
    assert relit.mode == mode
    assert np.array_equal(np.array(relit), expected.numpy())


def test_labels_of_a_sample_stay_and_its_image_changes():
    size = (8, 8)
    sample = {
        "image": tv_tensors.Image(picture(3, *size)),
        "boxes": tv_tensors.BoundingBoxes([[1, 2, 5, 6]], format="XYXY", canvas_size=size),
        "masks": tv_tensors.Mask(picture(2, *size) > 99),
        "points": torch.rand(4, 2),
        "depth": torch.rand(*size) + 1,
        "labels": torch.tensor([3]),
        "name": "orange",
    }
    relit = nb.RandomLighting(["point"])(sample)
    for key in sample.keys() - {"image"}:
        assert relit[key] is sample[key]
    assert type(relit["image"]) is tv_tensors.Image
    assert not torch.equal(relit["image"], sample["image"])


@pytest.mark.parametrize("kind, key", [(dict, "image"), (dict, "img"), (UserDict, "pixel_values")])
def test_plain_tensors_and_pil_masks_beside_a_named_image_stay(kind, key):
    """The processors of transformers return a `UserDict`."""
    sample = {"boxes": torch.rand(2, 4), "mask": picture(1, 6, 6), "labels": torch.tensor([1, 2])}
    sample["segmentation_map"] = Image.new("L", (6, 6), 3)
    relit = nb.RandomLighting("linear")(kind(sample | {key: picture(3, 6, 6)}))
    assert type(relit) is kind and all(relit[label] is sample[label] for label in sample)
    assert not torch.equal(relit[key], picture(3, 6, 6))


def test_a_path_at_the_key_of_an_image_names_no_image():
    relit = nb.RandomLighting("linear")({"image": "a.png", "photo": Image.new("RGB", (6, 6), 99)})
    assert relit["image"] == "a.png" and relit["photo"].getextrema() != ((99, 99),) * 3


@pytest.mark.parametrize("kind", [list, tuple])
def test_all_images_of_a_list_change_and_its_boxes_stay(kind):
    images = kind(picture(3, 6, 6 + extra) for extra in range(3))
    boxes = kind(torch.rand(2, 4) for _ in images)
    relit = nb.RandomLighting("linear")({"boxes": boxes, "images": images})
    pairs = [*zip(relit["images"], images, strict=True)]
    assert all(new.shape == old.shape and not torch.equal(new, old) for new, old in pairs)
    assert all(new is old for new, old in zip(relit["boxes"], boxes, strict=True))


def test_each_image_of_a_list_of_samples_has_its_own_depth():
    transform = nb.RandomLighting("point")
    samples = [{"depth": torch.rand(6, 6) + 1, "image": picture(3, 6, 6)} for _ in range(2)]
    torch.manual_seed(0)
    relit = transform(samples)
    torch.manual_seed(0)
    light = transform.make_params()
    for new, old in zip(relit, samples, strict=True):
        assert new["depth"] is old["depth"]
        assert torch.equal(new["image"], transform.apply(old["image"], light, old["depth"]))


def test_a_batch_has_a_light_for_each_image_and_a_video_has_one():
    image = picture(3, 6, 6)
    batch = nb.RandomLighting("linear")(image.expand(4, 3, 6, 6))
    assert len({tuple(values.flatten().tolist()) for values in batch}) == 4
    video = nb.RandomLighting("low_light")(tv_tensors.Video(image.expand(4, 3, 6, 6)))
    assert type(video) is tv_tensors.Video and (video == video[0]).all()


@pytest.mark.parametrize("name", MODELS)
def test_a_drawn_light_is_replayed_and_a_batch_equals_its_images(name):
    transform, images = nb.RandomLighting([name, "linear"]), picture(4, 3, 7, 9)
    params = transform.make_params([images])
    batch = transform.apply(images, params)
    assert torch.equal(batch, transform.apply(images, params))
    for image, relit, light in zip(images, batch, params["lights"], strict=True):
        single = transform.apply(image, {"lights": [light]})
        assert (single.int() - relit.int()).abs().max() <= 1


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
def test_images_of_a_batch_without_light_stay_for_every_dtype(dtype):
    images = picture(6, 4, 3, 3).clamp(max=1).to(dtype)
    transform = nb.RandomLighting(["linear", "highlights"])
    params = transform.make_params([images])
    params["lights"][2] = params["lights"][5] = None
    relit = transform.apply(images, params)
    assert relit.dtype == dtype
    assert torch.equal(relit[2], images[2]) and torch.equal(relit[5], images[5])


@pytest.mark.parametrize("name", MODELS)
def test_autocast_changes_nothing(name):
    images, transform = torch.rand(2, 3, 6, 6), nb.RandomLighting(name)
    light = transform.make_params([images])
    expected = transform.apply(images, light)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.equal(transform.apply(images, light), expected)


@pytest.mark.parametrize("name", MODELS)
def test_default_types_and_devices_change_nothing(name):
    # The device "meta" stands for a GPU: random numbers and tables have to be on the CPU.
    images, transform = picture(2, 3, 6, 6), nb.RandomLighting(name)

    def relit():
        torch.manual_seed(0)
        return transform(images), nb.relight_photographs(images)

    expected = relit()
    for dtype in (torch.float64, torch.bfloat16):
        try:
            torch.set_default_dtype(dtype)
            with torch.device("meta"):
                found = relit()
            assert torch.get_default_dtype() == dtype
        finally:
            torch.set_default_dtype(torch.float32)
        assert all(map(torch.equal, found, expected))


@pytest.mark.filterwarnings("ignore:an image has values above")
@pytest.mark.parametrize("name", MODELS)
def test_the_limits_of_half_precision_stay_finite(name):
    for value in (-0.1, 65504.0, 6e-8):
        image = torch.full((3, 4, 4), value, dtype=torch.float16)
        assert nb.RandomLighting(name)(image).isfinite().all()


@pytest.mark.parametrize("settings", [{"p": 0.0}, {"strength": 0.0}])
def test_without_light_an_image_stays(settings):
    image = torch.rand(3, 4, 4)
    assert torch.equal(nb.RandomLighting(**settings)(image), image)


def test_the_fraction_p_of_the_images_changes():
    images = picture(3, 2, 2).expand(400, 3, 2, 2)
    relit = nb.RandomLighting("highlights", p=0.25)(images)
    changed = (relit != images).flatten(1).any(1).sum()
    assert stats.binomtest(int(changed), 400, 0.25).pvalue > 1e-4


def test_strength_mixes_with_the_unchanged_light():
    model = lights.CastShadow()
    drawn = model.draw(draw_values(model), (5, 5))
    mixed = 0.7 + 0.3 * model.illumination(drawn).total()
    torch.testing.assert_close(model.illumination(drawn, 0.3).total(), mixed)


@pytest.mark.parametrize("name", MODELS)
def test_values_above_1_are_not_clipped_unless_the_sensor_is_full(name):
    relit = nb.RandomLighting(name)(8 * torch.rand(3, 9, 9))
    assert relit.isfinite().all()
    if name in ("color_temperature", "linear", "highlights"):
        assert relit.max() > 2


def test_workers_draw_other_lights_in_each_epoch_and_the_same_in_each_run():
    transform = pickle.loads(pickle.dumps(nb.RandomLighting(["cast_shadow", "low_light"])))
    data, runs = [picture(3, 8, 8)] * 4, []
    for _ in range(2):
        torch.manual_seed(3)
        loader = DataLoader(_Relit(data, transform), 2, num_workers=2, persistent_workers=True)
        runs.append(torch.cat([batch for _ in range(2) for batch in loader]))
    assert torch.equal(*runs)
    assert len(runs[0].flatten(1).unique(dim=0)) == 8


class _Relit(torch.utils.data.Dataset):
    def __init__(self, images, transform):
        self.images, self.transform = images, transform

    def __len__(self):
        return len(self.images)

    def __getitem__(self, index):
        return self.transform(self.images[index])


def test_a_subclass_keeps_its_attributes_as_images_of_monai_need():
    image = picture(3, 6, 6).as_subclass(type("Meta", (torch.Tensor,), {}))
    image.affine = torch.eye(4)
    relit = nb.RandomLighting("linear")(image)
    assert type(relit) is type(image) and relit.affine is image.affine


@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32])
def test_a_batch_keeps_channels_last(dtype):
    images = picture(2, 3, 6, 6).to(dtype).contiguous(memory_format=torch.channels_last)
    relit = nb.RandomLighting(["linear", "low_light"])(images.clamp(max=1))
    assert relit.is_contiguous(memory_format=torch.channels_last)


@pytest.mark.parametrize("name", list(MODELS))
def test_a_drawn_light_depends_on_neither_the_layout_nor_the_precision(name):
    images = picture(2, 3, 9, 7) / 255
    transform = nb.RandomLighting(name)
    drawn = transform.make_params([images])
    expected = transform.apply(images, drawn)
    for other in (images.contiguous(memory_format=torch.channels_last), images.double()):
        torch.testing.assert_close(
            transform.apply(other, drawn).float(), expected, rtol=0, atol=2e-5
        )


def test_bytes_are_exactly_rounded():
    # All bytes in 300 lights, against the curve in double precision.
    light = torch.rand(300, generator=torch.Generator().manual_seed(0)) * 3
    colors = torch.arange(256, dtype=torch.uint8).view(1, 1, 256, 1).expand(1, 1, 256, 300)
    relit = lighting.relit_bytes(colors, Illumination(light.expand(1, 1, 256, 300)))
    linear = decode(colors.double() / 255, "srgb") * light.double()
    exact = 255 * encode(linear.clamp(max=1), "srgb")
    # 32-bit numbers can round a value that is half way in either direction.
    assert (relit - exact).abs().max() < 0.5 + 1e-4


LOOPS = ("relit_bytes", "noisy_bytes", "ramps", "shadows", "lamps", "multiply_slides")


@pytest.mark.parametrize("name", [*lights.CastShadow().kinds, *MODELS])
def test_the_light_of_the_loops_equals_that_of_torch(name, monkeypatch):
    model = MODELS[name]() if name in MODELS else lights.CastShadow((name,))
    drawn = model.draw(draw_values(model, 3), (33, 65), seeds=[0, 1, 2])
    lit, mixed = model.illumination(drawn).total(), model.illumination(drawn, 0.3).total()
    for loop in LOOPS:
        monkeypatch.setattr(loops, loop, lambda *_: None)
    for strength, light in ((1.0, lit), (0.3, mixed)):
        expected = model.illumination(drawn, strength).total()
        torch.testing.assert_close(light, expected.expand_as(light), atol=1e-4, rtol=1e-4)


def test_noisy_bytes_equal_what_the_camera_measures():
    model, image = lights.LowLight(), picture(1, 3, 33, 65)
    light = lighting.Light(model, draw_values(model)[0], 3, 1.0)
    relit = nb.RandomLighting().apply(image, {"lights": [light]})
    exact = nb.RandomLighting().apply(image / 255, {"lights": [light]})
    assert (relit / 255 - exact).abs().max() < 0.51 / 255


def test_a_pixel_of_a_slide_belongs_to_the_cell_whose_center_is_nearest():
    [shown] = patterns.draw_cells(1, (30, 50), torch.Generator().manual_seed(3))
    draws = torch.Generator().manual_seed(3)
    count = int(torch.randint(patterns.MIN_CELLS, patterns.MAX_CELLS + 1, (1,), generator=draws))
    centers = 2 * torch.rand(patterns.MAX_CELLS, 2, generator=draws)[:count] - 1
    centers[:, 1] *= 30 / 50
    points = patterns.pixel_centers((30, 50)).flatten(1).T
    _, nearest = spatial.cKDTree(centers.numpy()).query(points.numpy())
    colors = shown.flatten(1).T.numpy()
    for cell in range(count):
        assert len(np.unique(colors[nearest == cell], axis=0)) <= 1
    assert len(np.unique(colors, axis=0)) == len(np.unique(nearest))


@pytest.mark.parametrize("distance", [-1.5, -1.0, -0.6, -0.1, 0.0, 0.3, 0.99, 1.0, 2.0])
def test_the_penumbra_is_the_visible_area_of_a_disc(distance):
    edge = min(max(distance, -1), 1)
    area = 2 * integrate.quad(lambda x: math.sqrt(1 - x * x), -1, edge)[0]
    visible = 0.5 + circle_segment(torch.tensor(distance)) / math.pi
    assert visible == pytest.approx(area / math.pi, abs=1e-5)


def test_a_point_light_over_a_plane_falls_off_as_the_third_power_of_the_cosine():
    model = lights.PointLight()
    values = draw_values(model)
    values[0, 0] = 0  # A plane.
    values[0, 1:3] = 0.5  # A lamp above the center.
    light = model.illumination(model.draw(values, (1, 101))).total()[0, 0, 0]
    height = 0.4 * 5 ** float(values[0, 3])
    dark, bright = patterns.AMBIENT
    ambient = dark + (bright - dark) * float(values[0, 4])
    x = (np.arange(101) - 50) * 2 / 101
    expected = (1 + (x / height) ** 2) ** -1.5 + ambient
    np.testing.assert_allclose(light / light[50], expected / expected[50], rtol=1e-4)


def test_the_normals_of_a_tilted_plane_follow_from_its_depth():
    # The plane z = 2 + x / 2 + y / 4, seen by a camera with a field of view of 60 degrees.
    tangent, width, height = math.tan(math.radians(30)), 40, 30
    x, y = ((np.arange(count) + 0.5 - count / 2) * 2 / width * tangent for count in (width, height))
    depth = 2 / (1 - x / 2 - y[:, None] / 4)
    surface = surfaces.surface_of_depth(torch.tensor(depth).float()[None, None])
    torch.testing.assert_close(
        surface.slope_right[..., 1:-1, 1:-1].mean(), torch.tensor(-0.5), atol=2e-3, rtol=0
    )
    torch.testing.assert_close(
        surface.slope_down[..., 1:-1, 1:-1].mean(), torch.tensor(-0.25), atol=2e-3, rtol=0
    )


@pytest.mark.parametrize(
    ("kelvin", "offset", "x", "y"),
    [
        # CIE standard illuminants A and D65. D65 is 0.0032 above the Planckian locus.
        (2855.54, 0.0, 0.44758, 0.40745),
        (6504, 0.00320, 0.31272, 0.32903),
        # Black bodies (CIE 15:2004).
        (4000, 0.0, 0.3805, 0.3768),
        (10000, 0.0, 0.2807, 0.2884),
    ],
)
def test_chromaticities_of_lamps_are_those_of_the_cie(kelvin, offset, x, y):
    rgb = patterns.planckian_rgb(torch.full((1, 1, 1), float(kelvin)).double(), offset).flatten()
    to_xyz = np.array(
        [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
    )
    xyz = to_xyz @ rgb.numpy()
    np.testing.assert_allclose(xyz[:2] / xyz.sum(), [x, y], atol=1e-3)


@pytest.mark.parametrize(("value", "recovered"), [(0.8, 0.6), (0.3, 0.0)])
@pytest.mark.parametrize("linear", [0.0, 0.02, 0.2, 1.0])
def test_low_light_has_the_mean_and_variance_of_photons_and_amplifier(linear, value, recovered):
    model = lights.LowLight()
    values = torch.tensor([[0.8, 0.5, value]])
    radiance = torch.full((1, 1, 300, 300), linear)
    drawn = model.draw(values, (300, 300), seeds=[1])
    measured = model.camera(radiance, drawn, 1.0, torch.tensor(1.0)).flatten().double()
    stops = 0.8 * math.log2(1 / 0.005)
    mean, gain = linear * 15000 * 2**-stops, 2 ** (recovered * stops) / 15000
    draws = np.random.default_rng(0)
    signal = gain * (draws.poisson(mean, 90000) + 3 * draws.normal(size=90000))
    expected = np.round(signal.clip(0, 1) * 4095) / 4095
    assert float(measured.mean()) == pytest.approx(expected.mean(), rel=0.02, abs=1e-5)
    assert float(measured.std()) == pytest.approx(expected.std(), rel=0.04)


def test_the_noise_of_low_light_is_that_of_poisson_and_gaussian_numbers():
    z = stats.norm.ppf((np.arange(20000) + 0.5) / 20000)
    for mean in (0.0, 0.1, 1, 3, 10, 100):
        for read in (1.0, 2.0, 5.0):
            variance = mean + read**2
            drawn = np.sort(mean + math.sqrt(variance) * z + mean / variance * (z * z - 1) / 6)
            counts = np.arange(stats.poisson.ppf(1 - 1e-9, mean) + 1)
            parts = stats.norm.cdf(drawn[:, None], counts, read) * stats.poisson.pmf(counts, mean)
            error = np.abs(parts.sum(1) - (np.arange(20000) + 0.5) / 20000).max()
            assert error < 0.01, (mean, read)


@pytest.mark.parametrize("name", ["directional", "cast_shadow"])
def test_the_light_is_differentiable_after_inference(name):
    model = MODELS[name]()
    with torch.inference_mode():
        model.illumination(model.draw(draw_values(model), (5, 11)))
    values = draw_values(model).requires_grad_()
    model.illumination(model.draw(values, (5, 11))).total().sum().backward()
    assert values.grad.isfinite().all()


@pytest.mark.parametrize("name", [*sorted(set(MODELS) - {"low_light"}), *lights.CastShadow().kinds])
def test_the_gradient_of_the_light_is_that_of_finite_differences(name):
    model = MODELS[name]() if name in MODELS else lights.CastShadow((name,))
    values = (0.1 + 0.8 * draw_values(model, seed=4)).double()
    weights = torch.rand(1, 3, 6, 7, generator=torch.Generator().manual_seed(0)).double()
    first, others = values.tensor_split([min(model.dimensions, 8)], dim=1)

    def weighted(first):
        drawn = model.draw(torch.cat([first, others], dim=1), (6, 7), seeds=[0])
        radiance = 0.1 * model.illumination(drawn).total()
        return (weights * radiance).sum()

    # The light has an infinite curvature where a penumbra begins.
    tolerance = {"eps": 1e-8, "rtol": 1e-3, "atol": 1e-4}
    assert torch.autograd.gradcheck(weighted, first.requires_grad_(), **tolerance)


@pytest.mark.ecosystem
def test_albumentations_relights_arrays_and_pickles():
    albumentations = pytest.importorskip("albumentations")
    transform = nb.RandomLighting(["linear"]).albumentations()
    transform = pickle.loads(pickle.dumps(transform))
    array = picture(6, 8, 3).numpy()
    relit = [albumentations.Compose([transform], seed=3)(image=array)["image"] for _ in range(2)]
    assert relit[0].dtype == np.uint8 and relit[0].shape == array.shape
    assert np.array_equal(*relit) and not np.array_equal(relit[0], array)
    unit = albumentations.Compose([transform], seed=3)(image=(array / 255).astype(np.float32))
    assert np.abs(unit["image"] * 255 - relit[0]).max() < 0.51


@pytest.mark.ecosystem
def test_albumentations_keeps_lights_in_dictionaries_and_random_numbers_in_pickles():
    albumentations = pytest.importorskip("albumentations")
    shadow = nb.lights.CastShadow(("leaves",))
    first = nb.RandomLighting({"linear": 2.0, shadow: 1.0}, p=0.9, strength=0.7).albumentations()
    nb.RandomLighting("low_light").albumentations()
    restored = albumentations.from_dict(albumentations.to_dict(first))
    assert albumentations.to_dict(restored) == albumentations.to_dict(first)
    assert repr(restored.lighting) == repr(first.lighting) and restored.p == 0.9
    named = albumentations.to_dict(nb.RandomLighting("point").albumentations())
    assert json.loads(json.dumps(named))["transform"]["lights"] == {"point": 1.0}
    compose = albumentations.Compose([first], seed=5)
    copy, array = pickle.loads(pickle.dumps(compose)), picture(6, 8, 3).numpy()
    for _ in range(3):
        assert np.array_equal(compose(image=array)["image"], copy(image=array)["image"])


@pytest.mark.ecosystem
def test_albumentations_draws_other_lights_in_each_worker_and_epoch():
    albumentations = pytest.importorskip("albumentations")
    light = albumentations.Compose([nb.RandomLighting("linear").albumentations()], seed=5)

    class Relit(torch.utils.data.Dataset):
        def __len__(self) -> int:
            return 4

        def __getitem__(self, index: int) -> np.ndarray:
            return light(image=np.full((4, 6, 3), 128, np.uint8))["image"]

    options = {"num_workers": 2, "multiprocessing_context": "fork"}
    loader = torch.utils.data.DataLoader(Relit(), 2, **options)

    def draw() -> list[bytes]:
        torch.manual_seed(0)
        return [image.numpy().tobytes() for _ in range(2) for batch in loader for image in batch]

    first = draw()
    assert len({*first}) == len(first) == 8
    assert draw() == first


def test_the_seed_of_a_function_holds_while_other_threads_draw_random_numbers():
    images = picture(3, 8, 8)

    def relight(seed: int) -> torch.Tensor:
        return nb.relight_photographs(images, seed, lights=["linear", "lamps"])

    alone = [relight(seed) for seed in range(4)]
    state = torch.get_rng_state()
    with ThreadPoolExecutor(8) as pool:
        together = [*pool.map(relight, [*range(4)] * 25)]
    assert all(torch.equal(each, alone[row % 4]) for row, each in enumerate(together))
    assert torch.equal(torch.get_rng_state(), state)


def test_normalized_images_are_refused_and_floats_of_bytes_give_a_warning():
    images = picture(2, 3, 8, 8)
    with pytest.raises(nb.InputError, match="before Normalize"):
        nb.RandomLighting("linear")((images / 255 - 0.5) / 0.2)
    with pytest.warns(UserWarning, match="divide them by 255"):
        nb.RandomLighting("linear")(images.float())
