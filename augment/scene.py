"""The examples an augmentation renders: every mesh from every view over every background, as stacked operators."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from renderer.cache import OperatorCache
from renderer.camera import ring
from renderer.errors import FACTOR, InputError, require_bounded, require_range
from renderer.harmonics import live_coefficients
from renderer.image import PictureSettings, behind, clamped, develop_composite
from renderer.mesh import Mesh, load_mesh, normalise
from renderer.shapes import solid
from renderer.transfer import COEFFICIENTS, DEGREE, Operator, apply_transfer
from renderer.visibility import Backend


@dataclass
class ObjectSettings:
    """One mesh of a scene.

    mesh: a file that trimesh reads, or `solid:NAME` or `solid:NAME:SEED`, a built-in procedural solid. label: the
    name of its class. up: the axis that points up in the file, auto|y|z. gain: multiplies the albedo.
    """

    mesh: str
    label: str
    up: str = "auto"
    gain: float = 1.0

    def __post_init__(self):
        require_range(f"scene.meshes: {self.mesh}: gain", self.gain, 1 / FACTOR, FACTOR)


@dataclass(frozen=True)
class SceneObject:
    """The operators (one per view) of one mesh, and the name of its class."""

    label: str
    operators: Sequence[Operator]


def count_views(examples: int, objects: int, backgrounds: int, views: int | None) -> int:
    """Views per mesh, so that meshes × views × backgrounds are the examples; views=None derives them.

    The paper's 100 examples are 2 meshes × 10 views × 5 backgrounds. InputError where no such product exists.
    """
    if not objects or not backgrounds:
        raise InputError("scene.meshes and scene.backgrounds must not be empty: name one mesh and one background")
    derived, rest = divmod(examples, objects * backgrounds)
    if rest or derived < 1:
        raise InputError(
            f"augment.examples={examples} is not a multiple of {objects} meshes × {backgrounds} backgrounds: "
            f"set it to a multiple of {objects * backgrounds}"
        )
    if views is not None and views != derived:
        raise InputError(
            f"augment.examples={examples} is not {objects} meshes × {views} views × {backgrounds} backgrounds = "
            f"{objects * views * backgrounds}: change one of them, or set scene.views=null to derive the views"
        )
    return derived


def build_objects(
    objects: Sequence[ObjectSettings],
    views: int,
    field_of_view: float,
    settings: PictureSettings,
    backend: Backend,
    cache: OperatorCache | None = None,
) -> list[SceneObject]:
    """Load and normalise every mesh, and rasterise it from a ring of views where the cache does not have them."""
    cache, cameras = cache or OperatorCache(), ring(views, field_of_view)
    return [
        SceneObject(item.label, cache.operators(load_object(item), cameras, settings, backend, item.gain))
        for item in objects
    ]


def load_object(item: ObjectSettings) -> Mesh:
    """The mesh, normalised. InputError: as `load_mesh` and `solid`."""
    kind, _, name = item.mesh.partition(":")
    if kind != "solid":
        return normalise(load_mesh(item.mesh, up=item.up))
    name, _, seed = name.partition(":")
    if seed and not seed.isdecimal():
        raise InputError(f"scene.meshes: the seed in {item.mesh!r} must be a whole number, as in solid:orange:3")
    return normalise(solid(name, int(seed or 0)))


class Scene:
    """E = views of all meshes × backgrounds examples, in that order, each lit by a light of its own.

    Views share nothing but the index of pixels that any of them covers; the other pixels are neither stored nor
    shaded. Backgrounds share their view's operator.
    """

    def __init__(
        self,
        objects: Sequence[SceneObject],
        backgrounds: Sequence[float],
        settings: PictureSettings,
        device: torch.device | str = "cpu",
    ):
        if not all(0 <= grey <= 1 for grey in backgrounds):
            raise InputError(f"scene.backgrounds={list(backgrounds)}: give grey values in [0, 1]")
        operators = [operator for item in objects for operator in item.operators]
        self.settings = settings
        self.labels = [item.label for item in objects for _ in item.operators for _ in backgrounds]
        self.pixels = torch.cat([operator.pixels for operator in operators]).unique()
        self.transfer, self.albedo, self.coverage = _stack(operators, self.pixels)
        self.backgrounds = torch.tensor(backgrounds, dtype=torch.float32)
        self._coefficients = _kept_coefficients()
        for name in ("pixels", "transfer", "albedo", "coverage", "backgrounds", "_coefficients"):
            setattr(self, name, getattr(self, name).to(device))
        greys = self.backgrounds.view(-1, 1, 1)
        self._behind = behind(self.coverage[:, None], greys, settings.encoding).flatten(0, 1)  # (E, 1, P)

    def __len__(self) -> int:
        return len(self.labels)

    def render(self, lights: Tensor, examples: Tensor | None = None) -> Tensor:
        """Pictures (A, 3, size, size) in [0, 1] of lights (A, 49, 3); differentiable in the lights.

        examples: (A,) ascending indices, when not all are wanted; operators that they do not need are left alone.
        """
        if examples is None:
            examples = torch.arange(len(self), device=lights.device)
        covered = develop_composite(self._composite(lights, examples), self.settings.encoding)
        greys = self.backgrounds[examples % len(self.backgrounds)].view(-1, 1, 1)
        pictures = greys.repeat(1, 3, self.settings.size**2).index_copy(2, self.pixels, covered)
        return pictures.unflatten(2, (self.settings.size, self.settings.size))

    def clamped_share(self, lights: Tensor) -> Tensor:
        """Per example, the share of its covered pixels' values that the clamp changes. (E,)"""
        examples = torch.arange(len(self), device=lights.device)
        over = clamped(self._composite(lights, examples))
        covered = (self.coverage[examples // len(self.backgrounds)] > 0).expand_as(over)
        return (over & covered).sum((1, 2)) / covered.sum((1, 2)).clamp(min=1)

    def _composite(self, lights: Tensor, examples: Tensor) -> Tensor:
        """Radiance and what is behind it of A examples, linear (A, 3, P).

        One product per operator, for all of its backgrounds at once: lights are laid out on a grid of the operators
        in use × backgrounds, which leaves gaps where an example is not wanted.
        """
        per_operator = len(self.backgrounds)
        used, row = torch.unique(examples // per_operator, return_inverse=True)
        cell = row * per_operator + examples % per_operator
        kept = lights.index_select(1, self._coefficients)
        grid = kept.new_zeros(len(used) * per_operator, *kept.shape[1:]).index_copy(0, cell, kept)
        everything = len(used) == len(self.transfer)
        transfer, albedo = (part if everything else part[used] for part in (self.transfer, self.albedo))
        radiance = apply_transfer(grid.unflatten(0, (len(used), per_operator)), transfer, albedo)
        radiance = radiance.flatten(0, 1).index_select(0, cell)
        require_bounded(radiance=radiance)
        return radiance + self._behind[examples]


def _kept_coefficients() -> Tensor:
    """The 31 live coefficients and a dead one, whose row is zero: 32 rows make the gradient's product twice as fast."""
    live = live_coefficients(DEGREE)
    dead = next(index for index in range(COEFFICIENTS) if index not in live)
    return torch.cat([live, torch.tensor([dead])])


def _stack(operators: Sequence[Operator], pixels: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Operators over a common set of pixels: transfer (O, 3 or 1, 32, P), albedo (O, 3, P) and coverage (O, 1, P)."""
    channels = max((len(operator.transfer) for operator in operators), default=1)
    transfer = torch.zeros(len(operators), channels, len(_kept_coefficients()), len(pixels))
    albedo = torch.ones(len(operators), 3, len(pixels))
    coverage = torch.zeros(len(operators), 1, len(pixels))
    for row, operator in enumerate(operators):
        columns = torch.searchsorted(pixels, operator.pixels)
        if channels == 1:
            transfer[row][:, :-1, columns], albedo[row][:, columns] = operator.transfer, operator.albedo
        else:
            transfer[row][:, :-1, columns] = operator.transfer * operator.albedo[:, None]
        coverage[row, 0, columns] = operator.coverage
    return transfer, albedo, coverage
