"""Random light on images, as a transform of torchvision and of Albumentations, and as a function.

Colors are decoded to linear light, multiplied by the light of a model, and encoded (sRGB). Images
of 8 bits use tables: a decoded value for each byte, and the byte of each linear value, exactly
rounded. With numba installed, one loop does all of this.
"""

from __future__ import annotations

import math
import warnings
from bisect import bisect
from collections import UserDict
from collections.abc import Mapping, Sequence
from copy import copy
from functools import cache
from itertools import accumulate
from typing import Any, NamedTuple, cast

import numpy as np
import torch
from jaxtyping import Float, Int32, UInt8
from PIL import Image
from torch import Tensor
from torch.utils._pytree import SequenceKey, tree_flatten_with_path, tree_unflatten
from torchvision import tv_tensors
from torchvision.transforms import v2

from augment.random_streams import generator, usual_defaults
from augment.scene import loops
from augment.scene.lights import MODELS, Drawn, Illumination, LightModel, LowLight, normal_noise
from augment.scene.loops import BIN_BITS, BINS
from augment.scene.patterns import as_photographs, by_kind, draw_projected_light, luminance
from renderer import errors
from renderer.errors import InputError
from renderer.image import OVERSHOOT, decode, encode, to_bytes, to_unit
from renderer.modes import without_autocast

# Keys of a sample at which a plain tensor is an image, whatever stands before it.
IMAGES = ("image", "images", "img", "pixel_values")
# Modes of Pillow's images that are relit as they are, and those that are converted before.
MODES = ("L", "LA", "RGB", "RGBA", "F", "I;16", "I;16L", "I;16B", "I;16N")
CONVERTED = {"1": "L", "P": "RGB", "PA": "RGBA", "CMYK": "RGB", "YCbCr": "RGB", "HSV": "RGB"}
# Floats above this value are hardly those of an HDR image.
BRIGHTEST = 100


class Light(NamedTuple):
    """Light of one image: its model, numbers in [0, 1], seed of the noise, and strength."""

    model: LightModel
    values: Float[Tensor, " D"]
    seed: int
    strength: float


class RandomLighting(v2.Transform):  # type: ignore[misc, unused-ignore]
    """Show images in random light.

    A transform of torchvision (v2). It takes an image or a sample with images,
    and changes the images only. An image is a PIL image, or a tensor of any
    dtype and of shape (..., C, H, W), with 1 to 4 channels. A second or fourth
    channel is alpha and stays. Of plain tensors in a sample, only the first is an
    image, or those of a key "image", "images", "img" or "pixel_values". Each image
    of a batch has its own light, and all frames of a `tv_tensors.Video` have the
    same. Values above 1 (HDR) are not clipped. The random numbers are from torch's
    global generator on the CPU.

    The colors of an image (sRGB) stand for the albedo of what it shows. They
    are decoded to linear light, multiplied by the light of a model, and encoded
    again. The models are in `nb.lights`:

    - "projected_slide": a projector shows a picture on a print,
    - "cast_shadow": a polygon, leaves, blinds or a window cast a shadow with a
      penumbra,
    - "directional", "point", "lamps": a distant light, a small lamp, or one to
      three colored lamps light a random smooth surface,
    - "linear", "fractal": light that rises from side to side, or is cloudy,
    - "color_temperature": black-body light with a wrong white balance,
    - "low_light": little light, with the noise of a camera,
    - "highlights": an exposure that is too long,
    - "stripes": stripes, waves or one border of a scanner, of full contrast.

    A sample may have the key "depth": distances from the camera in any unit,
    with the height and width of the images. "projected_slide", "directional",
    "point" and "lamps" then light the surface of these depths. The depth itself
    stays.

    Args:
        lights: Names or objects of the models, of which one is drawn for each
            image, or a dictionary of their relative weights. None for all but
            "stripes".
        p: Probability that an image is changed.
        strength: Fraction of the light that is random, in [0, 1]. At 0, images
            stay as they are.

    Raises:
        InputError: If a value is out of range, or a model is unknown.

    Example:
        >>> import torch
        >>> import norm_balls as nb
        >>> transform = nb.RandomLighting(["cast_shadow", "low_light"])
        >>> image = torch.full((3, 8, 12), 128, dtype=torch.uint8)
        >>> light = transform.make_params()
        >>> frames = [transform.apply(frame, light) for frame in (image, image)]
        >>> torch.equal(*frames)
        True
    """

    _transformed_types = (tv_tensors.Image, v2._utils.is_pure_tensor, Image.Image, tv_tensors.Video)

    def __init__(
        self,
        lights: Sequence[str | LightModel] | Mapping[Any, float] | str | None = None,
        p: float = 1.0,
        strength: float = 1.0,
    ):
        super().__init__()
        errors.require_number("p", p, 0, 1)
        errors.require_number("strength", strength, 0, 1)
        given = [name for name in MODELS if name != "stripes"] if lights is None else lights
        if not isinstance(given, Mapping):
            named = [given] if isinstance(given, str | LightModel) else given
            expected = "names, or models of nb.lights"
            given = dict.fromkeys(errors.as_list("lights", named, str | LightModel, expected), 1.0)
        self.p, self.strength = float(p), float(strength)
        for weight in given.values():
            errors.require_number("the weight of a light", weight, 0, errors.MAX_MAGNITUDE)
        self.lights = {_as_model(light): float(weight) for light, weight in given.items()}
        if not sum(self.lights.values()) > 0:
            raise InputError("lights has no model with a positive weight: give at least one")

    def extra_repr(self) -> str:
        """Return the settings as text."""
        return f"{self.lights}, p={self.p}, strength={self.strength}"

    def make_params(
        self, flat_inputs: Sequence[Any] = (), draws: torch.Generator | None = None
    ) -> dict[str, Any]:
        """Draw a light for each image of a batch, or one light.

        Args:
            flat_inputs: Images. Their largest batch gets as many lights.
            draws: Generator of random numbers on the CPU. None for torch's global one.

        Returns:
            Lights, which `apply` takes.
        """
        # A sample may have single images beside a batch.
        count = max([math.prod(_batch_shape(image)) for image in flat_inputs], default=1)
        models, weights = [*self.lights], [*self.lights.values()]
        lights: list[Light | None] = []
        with usual_defaults():
            seeds = torch.randint(2**62, (count,), generator=draws).tolist()
            chances = torch.rand(count, 2, generator=draws).tolist()
            for seed, (chance, choice) in zip(seeds, chances, strict=True):
                # Draw a model with a probability in proportion to its weight.
                model = models[bisect(list(accumulate(weights)), choice * sum(weights))]
                values = torch.rand(model.dimensions + model.constants, generator=draws)
                is_changed = chance < self.p and self.strength > 0
                lights.append(Light(model, values, seed, self.strength) if is_changed else None)
        return {"lights": lights}

    def apply(self, image: Any, params: dict[str, Any], depth: Any = None) -> Any:
        """Show an image in a light that was drawn before.

        Args:
            image: PIL image or tensor of any size. If one light was drawn, all
                images of a batch get it.
            params: Result of `make_params`.
            depth: Distances from the camera, of the size of the image. None for a
                flat image.

        Returns:
            Image of the same type, dtype, size and device.

        Raises:
            InputError: If the image has other channels, or the depth another
                size, or if there are fewer lights than images.
        """
        if isinstance(image, Image.Image):
            return _apply_to_pil(image, params["lights"], depth)
        if not isinstance(image, Tensor):
            kind = type(image).__name__
            raise InputError(f"the image is a {kind}: give a PIL image or a tensor (C, H, W)")
        relit = _apply_to_tensor(image, params["lights"], depth)
        if type(image) is not Tensor:
            relit = tv_tensors.wrap(relit, like=image)
            vars(relit).update(vars(image))  # Such as the affine matrix of an image of MONAI.
        return relit

    def transform(self, inpt: Any, params: dict[str, Any]) -> Any:
        """Show an image of a sample in the drawn light (called by torchvision)."""
        return self.apply(inpt, params, params.get("depth"))

    @torch.compiler.disable  # type: ignore[untyped-decorator, unused-ignore]
    def forward(self, *inputs: Any) -> Any:
        """Change the images of a sample.

        Args:
            inputs: Image, or sample of any structure.

        Returns:
            Sample with the same structure.

        Raises:
            InputError: If the sample has no image.
        """
        sample = inputs if len(inputs) > 1 else inputs[0]
        if isinstance(sample, UserDict):  # Such as what a processor of Transformers returns.
            relit = copy(sample)
            relit.update(self(sample.data))
            return relit
        if type(sample) in (Tensor, tv_tensors.Image):  # Without the time of a search.
            return self.transform(sample, self.make_params([sample]))
        paths, spec = tree_flatten_with_path(sample)
        leaves = [leaf for _, leaf in paths]
        keys = [_key_of(path) for path, _ in paths]
        # Keys of leaves that are no images: all but `IMAGES`, if one of those has an image.
        kinds = Tensor, Image.Image, np.ndarray
        named = [key for key, leaf in zip(keys, leaves, strict=True) if isinstance(leaf, kinds)]
        hidden = {"depth"} if {*IMAGES}.isdisjoint(named) else {*keys} - {*IMAGES}
        # Torchvision tells which of the others are images: the first of plain tensors.
        marked = tv_tensors.Image, tv_tensors.Video
        others = [
            None if key in hidden and (key == "depth" or not isinstance(leaf, marked)) else leaf
            for key, leaf in zip(keys, leaves, strict=True)
        ]
        found = zip(leaves, keys, self._needs_transform_list(others), strict=True)
        places = [
            place
            for place, (leaf, key, is_image) in enumerate(found)
            if is_image or (key in IMAGES and v2._utils.is_pure_tensor(leaf))
        ]
        if not places:
            raise InputError("the sample has no image: give a PIL image or a tensor (C, H, W)")
        depths = [leaf for leaf, key in zip(leaves, keys, strict=True) if key == "depth"] or [None]
        if len(depths) not in (1, len(places)):
            raise InputError(f"depth has {len(depths)} maps for {len(places)} images: give each")
        params = self.make_params([leaves[place] for place in places])
        for place, depth in zip(places, depths * (len(places) // len(depths)), strict=True):
            leaves[place] = self.transform(leaves[place], params | {"depth": depth})
        return tree_unflatten(leaves, spec)

    def albumentations(self) -> Any:
        """Return this transform as one of Albumentations, for arrays (H, W, C).

        Returns:
            `ImageOnlyTransform` with the probability p.

        Raises:
            InputError: If Albumentations is not installed.
        """
        return _albumentations_class()(self.lights, self.strength, self.p)


@torch.compiler.disable  # type: ignore[untyped-decorator, unused-ignore]
@without_autocast
def relight_photographs(
    photographs: Tensor | np.ndarray,
    seed: int = 0,
    *,
    slides: Tensor | np.ndarray | None = None,
    lights: Sequence[str | LightModel] | None = None,
    strength: float = 1.0,
) -> Tensor:
    """Show photographs in random light, by default in that of a projector with random slides.

    The light of the projector models a flat print with the shading of a random
    smooth surface. It needs neither meshes nor labels.

    Args:
        photographs: Photographs, sRGB of 8 bits, uint8, shape
            (N, 3, height, width). With lights, all images that
            `nb.RandomLighting` takes.
        seed: Seed of all random draws.
        slides: Photographs that the projector may show as slides, uint8, shape
            (M, 3, H, W). None for generated slides only.
        lights: Models of light, as `nb.RandomLighting` takes them. None for the
            projector.
        strength: Fraction of the light that is random, with lights.

    Returns:
        Photographs in random light, of the same dtype and shape.

    Raises:
        InputError: If the photographs have another dtype or shape.

    Example:
        >>> import torch
        >>> import norm_balls as nb
        >>> photographs = torch.full((2, 3, 8, 8), 128, dtype=torch.uint8)
        >>> nb.relight_photographs(photographs, seed=1).shape
        torch.Size([2, 3, 8, 8])
        >>> nb.relight_photographs(photographs, lights=["linear"]).dtype
        torch.uint8
    """
    errors.require_whole("seed", seed)
    if lights is not None:
        if slides is not None:
            advice = "give nb.lights.ProjectedSlide(slides) among the lights"
            raise InputError(f"slides are not used with lights: {advice}", "slides")
        if isinstance(photographs, np.ndarray):
            photographs = torch.from_numpy(np.require(photographs, requirements=["C", "W"]))
        # The seed of a global generator would not hold while other threads draw from it.
        lamps = RandomLighting(lights, strength=strength)
        return lamps.apply(photographs, lamps.make_params([photographs], generator(seed, "lights")))
    if strength != 1.0:
        raise InputError("strength is not used without lights: give lights", "strength")
    photographs = as_photographs("photographs", photographs)
    if slides is not None:
        slides = as_photographs("slides", slides)
    count, _, *shape = photographs.shape
    # Photographs stand for the albedo, and the light of the projector multiplies it.
    with usual_defaults():
        light = draw_projected_light(count, shape, generator(seed, "relight"), slides)
        return to_bytes(light.to(photographs.device).expose(decode(to_unit(photographs), "srgb")))


def _key_of(path: Sequence[Any]) -> Any:
    """Return the key at which a dictionary has a leaf, or a list with it."""
    named = [part for part in path if not isinstance(part, SequenceKey)]
    return getattr(named[-1], "key", None) if named else None


def _as_model(light: str | LightModel) -> LightModel:
    """Return a model, or that of a name."""
    if isinstance(light, LightModel):
        return light
    errors.require_choice("lights", light, MODELS)
    return MODELS[light]()


def _batch_shape(image: Any) -> tuple[int, ...]:
    """Return the shape of the batch of a tensor. All frames of a video are one image."""
    if not isinstance(image, Tensor):
        return ()
    if torch._C._functorch.is_batchedtensor(image):
        raise InputError("torch.vmap hides the batch of images: call the transform with the batch")
    return tuple(image.shape[: -4 if isinstance(image, tv_tensors.Video) else -3])


def _apply_to_pil(image: Image.Image, lights: Sequence[Light | None], depth: Any) -> Image.Image:
    """Relight a PIL image, in its mode. Integers of 32 bits hold 16 bits, as in PNG files."""
    if lights[0] is None or 0 in image.size:
        return image
    if image.mode in MODES or image.mode == "I":
        array = np.array(image)
        # Mode "I" has integers of 32 bits. Those that fit 16 bits are relit as integers of 16 bits.
        is_wide = image.mode == "I" and not 0 <= array.min() <= array.max() < 2**16
        # torch has no numbers with the highest byte first.
        if array.dtype.byteorder == ">" or (image.mode == "I" and not is_wide):
            array = array.astype(np.uint16)
        relit = _apply_to_array(array, lights, depth)
        made = Image.fromarray(relit.astype(np.array(image).dtype))
    elif image.mode in CONVERTED:
        mode = "RGBA" if "transparency" in image.info else CONVERTED[image.mode]
        made = _apply_to_pil(image.convert(mode), lights, depth)
        octree = Image.Quantize.FASTOCTREE
        made = made.quantize(method=octree) if image.mode == "P" else made.convert(image.mode)
    else:
        raise InputError(f"the image has the mode {image.mode}: convert it to RGB")
    made.info.update({key: value for key, value in image.info.items() if key != "transparency"})
    return made


def _apply_to_array(array: np.ndarray, lights: Sequence[Light | None], depth: Any) -> np.ndarray:
    """Relight an image of shape (H, W) or (H, W, C)."""
    pixels = torch.from_numpy(np.ascontiguousarray(array))
    image = pixels[None] if pixels.ndim == 2 else pixels.permute(2, 0, 1)
    relit = _apply_to_tensor(image, lights, depth).permute(1, 2, 0).numpy()
    return np.ascontiguousarray(relit).reshape(array.shape)


def _apply_to_tensor(image: Tensor, lights: Sequence[Light | None], depth: Any) -> Tensor:
    """Relight the images of a tensor, which are grouped by model."""
    plain = image.as_subclass(Tensor)
    if plain.ndim == 2:
        return _apply_to_tensor(plain[None], lights, depth)[0]
    is_number = plain.dtype != torch.bool and not plain.is_complex()
    if plain.ndim < 2 or not 1 <= plain.shape[-3] <= 4 or not is_number:
        dtype = str(image.dtype).removeprefix("torch.")
        fault = f"the image is {dtype} of shape {tuple(image.shape)}"
        raise InputError(f"{fault}: give real numbers of shape (..., C, H, W) with 1 to 4 channels")
    count = math.prod(_batch_shape(image))
    if not plain.numel() or plain.is_meta or not any(lights):
        return plain
    if len(lights) < count and len(lights) != 1:
        raise InputError(f"{len(lights)} lights were drawn for {count} images: draw one for each")
    lights = list(lights[:count]) if len(lights) >= count else [lights[0]] * count
    frames = plain.reshape(-1, *plain.shape[-3:])
    # All frames of a video have the light of their video.
    lights = [light for light in lights for _ in range(len(frames) // count)]
    if frames.is_floating_point():
        low, high = frames.detach().aminmax()
        if not (low >= -errors.MAX_MAGNITUDE and high <= errors.MAX_MAGNITUDE):
            limit = f"{errors.MAX_MAGNITUDE:g}"
            raise InputError(f"the image has values that are NaN or beyond ±{limit}: replace them")
        if low < -OVERSHOOT:
            advice = "give colors, and put the light before Normalize"
            raise InputError(f"the image has values down to {low:g}: {advice}")
        if high > BRIGHTEST:
            fault = f"an image has values above {BRIGHTEST}, such as those of bytes"
            warnings.warn(f"{fault}: divide them by 255 unless they are HDR", stacklevel=2)
    depths = None if depth is None else _as_depth(depth, frames, count)
    # Frames of one kind have the same model and the same strength. Unchanged frames have None.
    keys = [light and (id(light.model), light.strength) for light in lights]
    kinds = [*dict.fromkeys(keys)]

    def relight(kind: int, rows: list[int] | slice) -> Tensor:
        of_kind = zip(lights, keys, strict=True)
        chosen = [light for light, key in of_kind if light and key == kinds[kind]]
        depth_of_rows = None if depths is None else depths[rows]
        with usual_defaults():
            return _relight(frames[rows], chosen, depth_of_rows) if chosen else frames[rows]

    relit = by_kind([kinds.index(key) for key in keys], relight)
    if frames.is_contiguous(memory_format=torch.channels_last):
        relit = relit.contiguous(memory_format=torch.channels_last)
    return relit.reshape(plain.shape)


def _as_depth(depth: Any, frames: Tensor, count: int) -> Float[Tensor, "N 1 H W"]:
    """Convert depths to one for each frame."""
    values = errors.as_tensor("depth", np.array(depth) if isinstance(depth, Image.Image) else depth)
    values = values.as_subclass(Tensor).to(frames.device, torch.float32)
    size = frames.shape[-2:]
    errors.require_shape("depth", values, "...", *size)
    # A sample has one depth map, one for each image or video, or one for each frame.
    values = values.reshape(-1, 1, *size)
    if len(values) not in (1, count, len(frames)):
        raise InputError(f"depth has {len(values)} maps for {count} images: give one for each")
    return values.repeat_interleave(len(frames) // len(values), 0)


@without_autocast
def _relight(
    images: Tensor, lights: Sequence[Light], depth: Float[Tensor, "N 1 H W"] | None
) -> Tensor:
    """Relight images (N, C, H, W) in lights of one model and one strength."""
    model, strength = lights[0].model, lights[0].strength
    # Number of color channels: 1 of 1 or 2 channels, and 3 of 3 or 4. The rest is alpha.
    colored = images.shape[1] // 3 * 2 + 1
    colors = images[:, :colored]
    # Integers of more than 24 bits do not fit 32-bit numbers.
    is_large = images.dtype.itemsize > 2 and images.dtype != torch.float32
    dtype = torch.float64 if is_large else torch.float32
    values = torch.stack([light.values for light in lights]).to(images.device, dtype)
    drawn = model.draw(values, tuple(images.shape[-2:]), depth, [light.seed for light in lights])
    light = model.illumination(drawn, strength)
    if colored == 1:
        # The light of a gray image is the luminance.
        field, gain, offset = (
            luminance(part) if isinstance(part, Tensor) and part.shape[1] == 3 else part
            for part in light
        )
        light = Illumination(cast(Tensor, field), gain, offset)
    is_integer = not images.is_floating_point()
    largest = torch.iinfo(images.dtype).max if is_integer else 1
    if images.dtype == torch.uint8 and not values.requires_grad:
        if isinstance(model, LowLight):
            relit = _noisy_bytes(colors, model, drawn, strength)
        else:
            relit = relit_bytes(colors, light)
    else:
        unit = colors.to(dtype) / largest
        # The largest value of an image above 1 is its white, at which a sensor is full.
        white = decode(unit.detach().amax((1, 2, 3), keepdim=True).clamp(min=1), "srgb")
        linear = model.camera(decode(unit, "srgb") * light.total(), drawn, strength, white)
        limit = white if model.has_limit else torch.where(white > 1, torch.inf, white)
        encoded = encode(torch.minimum(linear, limit), "srgb")
        if is_integer:
            # The largest number of 64 bits is rounded up, which would overflow.
            most = math.nextafter(largest, 0) if float(largest) > largest else largest
            relit = (encoded * largest).round().clamp(max=most).to(images.dtype)
        else:
            most = torch.finfo(images.dtype).max
            relit = encoded.clamp(-most, most).to(images.dtype)
    return relit if colored == images.shape[1] else torch.cat([relit, images[:, colored:]], 1)


@cache
def _tables(device: torch.device) -> tuple[Float[Tensor, " 256"], Int32[Tensor, " bins"]]:
    """Return tables of sRGB of 8 bits, from double precision. A value half way is rounded up.

    The first has the linear value of each byte, in units of 1 / (BINS << BIN_BITS). If v is a whole
    number of these units, the nearest byte is (v + carry[v >> BIN_BITS]) >> BIN_BITS, where `carry`
    is the second: the sum has a carry in each bin of width 1 / BINS from the value on at which the
    byte changes.
    """
    unit = BINS << BIN_BITS
    decoded = decode(torch.arange(256, dtype=torch.float64) / 255, "srgb") * unit
    # Linear values at which the nearest byte changes.
    halves = decode((torch.arange(255, dtype=torch.float64) + 0.5) / 255, "srgb") * unit
    starts = torch.arange(BINS + 1) << BIN_BITS
    # Each bin has the byte `lowest` at its start, and the next one from its position `limit` on.
    lowest = torch.searchsorted(halves, starts.double(), right=True)
    limit = torch.cat([halves.ceil().long(), starts[-1:] * 2])[lowest] - starts
    carry = ((lowest + 1) << BIN_BITS) - limit.clamp(max=1 << BIN_BITS) - starts
    return decoded.float().to(device), carry.int().to(device)


def _noisy_bytes(
    colors: UInt8[Tensor, "N C H W"], model: LowLight, drawn: Drawn, strength: float
) -> UInt8[Tensor, "N C H W"]:
    """Return the nearest bytes of what a camera measures, from a table of its response to each."""
    # Response a + b z + c z² of each image to each of the 256 bytes, shape (N, 1, 1, 256).
    decoded = (_tables(colors.device)[0] / (BINS << BIN_BITS)).expand(len(colors), 1, 1, -1)
    response = model.response(decoded, drawn, strength, decoded.new_ones(()))
    z = normal_noise(decoded.new_empty(colors.shape), drawn.seeds)
    # Byte of each level of the camera's converter.
    levels = torch.arange(model.levels + 1, device=colors.device).view(1, 1, 1, -1) / model.levels
    encoded = relit_bytes(torch.full_like(levels, 255, dtype=torch.uint8), Illumination(levels))
    if loop := loops.noisy_bytes(z):
        parts = [part.flatten(1) for part in (colors, z, *response)]
        loop(*parts, encoded.flatten(), (noisy := torch.empty_like(parts[0])))
        return noisy.view(colors.shape)
    # Without a compiled loop: look up the coefficients at 256 · image + byte.
    first = 256 * torch.arange(len(colors), device=colors.device, dtype=torch.int32)
    index = (colors.int() + first[:, None, None, None]).flatten()
    middle, slope, curve = (part.flatten().index_select(0, index).view_as(z) for part in response)
    signal = curve.mul_(z).add_(slope).mul_(z).add_(middle).clamp_(0, model.levels).round_()
    return encoded.flatten().index_select(0, signal.int().flatten()).view(colors.shape)


def relit_bytes(colors: UInt8[Tensor, "N C H W"], light: Illumination) -> UInt8[Tensor, "N C H W"]:
    """Multiply the linear colors of bytes by light, and return the nearest bytes."""
    decoded, carry = _tables(colors.device)
    loop = loops.relit_bytes(light.field)
    # The light is gain · field + offset. The loop takes these parts instead of their sum.
    if loop is None:
        albedo = decoded.index_select(0, colors.flatten().int()).view(colors.shape)
        linear = (albedo * light.total()).clamp_(max=BINS << BIN_BITS).int()
        return ((linear + carry[linear >> BIN_BITS]) >> BIN_BITS).byte()
    parts = [part.numpy()[..., 0, 0] if isinstance(part, Tensor) else part for part in light[1:]]
    gain, offset = (np.full(colors.shape[:2], part, np.float32) for part in parts)
    relit = colors.new_empty(colors.shape)
    loop(colors, light.field, gain, offset, decoded, carry, relit)
    return relit


@cache
def _albumentations_class() -> Any:
    """Define the transform of Albumentations once, as its `from_dict` looks for it by its name."""
    albumentations: Any = errors.import_package("albumentations", "albumentations==2.0.8")

    class Lighting(albumentations.ImageOnlyTransform):  # type: ignore[misc, unused-ignore]
        """Random light on arrays (H, W, C)."""

        def __init__(self, lights: Any = None, strength: float = 1.0, p: float = 1.0):
            super().__init__(p=p)
            self.lighting = RandomLighting(lights, strength=strength)

        def get_params(self) -> dict[str, Any]:
            """Draw a light with a seed of Albumentations and of a worker of a data loader.

            Albumentations has the same numbers in all workers, and again in each epoch.
            """
            worker = torch.utils.data.get_worker_info()
            seed = self.py_random.getrandbits(62) ^ (worker.seed if worker else 0)
            return self.lighting.make_params((), torch.Generator().manual_seed(seed))

        def apply(self, img: np.ndarray, lights: Sequence[Light | None], **_: Any) -> np.ndarray:
            """Relight an array."""
            return _apply_to_array(img, lights, None)

        def get_transform_init_args(self) -> dict[str, Any]:
            """Return the arguments for `to_dict`: names of models that have no settings."""
            names = {repr(kind()): name for name, kind in MODELS.items()}
            lights = self.lighting.lights.items()
            named = {names.get(repr(model), model): weight for model, weight in lights}
            return {"lights": named, "strength": self.lighting.strength}

        def __reduce__(self) -> tuple[Any, ...]:
            return RandomLighting.albumentations, (self.lighting,), self.__dict__

    return Lighting
