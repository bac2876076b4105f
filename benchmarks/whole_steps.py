"""Whole light steps: an image with background and clamp, a loss, and its gradient by the light.

The operators of the library are timed beside `benchmarks.peer` and beside the
operator's step written out by hand. All images and gradients must be equal.
Otherwise the benchmark stops.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from statistics import median

import torch
from torch import Tensor

from benchmarks.common import Row, quartiles_of_ratio, times_in_turn
from benchmarks.peer import Peer
from benchmarks.scene import BACKGROUND, CAMERA, View, coefficients
from renderer.camera import orbit_cameras
from renderer.light.basis import DEGREE
from renderer.mesh import Mesh
from renderer.operators.apply import TransferOperator
from renderer.operators.build import build_operators
from renderer.operators.stack import TransferOperators
from renderer.settings import ImageSettings
from renderer.visibility import Rasterizer

# Number of views that one call renders, and their pixels per side.
MANY_VIEWS_COUNT = 100
MANY_VIEWS_SIZE = 32

AUTOGRAD_STEP = "image and autograd.grad"
DIRECT_STEP = "image_and_gradient"
HAND_STEP = "by hand"
PEER_STEP = "plain autograd that keeps all it can"
LOOP = "loop over operators"

Call = Callable[[], object]

# A call that returns the image, shape (3, size, size), and the gradient of the
# loss by the light, shape ((degree + 1)², 3).
WholeStep = Callable[[], tuple[Tensor, Tensor]]


@dataclass(frozen=True)
class Loss:
    """The loss Σ image × weights.

    Attributes:
        weights: Weight of each value of the image, shape (3, size, size), or of
            the images of V views, shape (V, 3, size, size).
    """

    weights: Tensor

    def gradient(self, image: Tensor) -> Tensor:
        """Compute the loss of an image, and return its gradient by the image.

        The loss itself is thrown away, but its time counts.

        Args:
            image: Image or images, in the shape of `weights`.

        Returns:
            Gradient, in the shape of `weights`.
        """
        _ = (image * self.weights).sum()
        return self.weights


@dataclass(frozen=True)
class AutogradStep:
    """A whole step whose gradient autograd computes.

    Attributes:
        render: Function from a light to its image or images.
        light: SH coefficients, shape ((degree + 1)², 3).
        loss: Loss of what `render` returns.
    """

    render: Callable[[Tensor], Tensor]
    light: Tensor
    loss: Loss

    def __call__(self) -> tuple[Tensor, Tensor]:
        """Render the light, and differentiate the loss by the light."""
        light = self.light.clone().requires_grad_()
        image = self.render(light)
        [gradient] = torch.autograd.grad((image * self.loss.weights).sum(), light)
        return image.detach(), gradient


class ByHand:
    """The practical limit of a whole light step.

    The products with the operator, the background, the mask of clamped values
    and the gradient are written out for one light of the operator's type, a
    gray background and linear values. There are no checks and no autograd.

    Args:
        operator: Operator of P covered pixels from the light to the image.
        background: Gray value in [0, 1].

    Attributes:
        shape: Shape (3, size, size) of the image.
        pixels: Row-major indices of the covered pixels for each channel, shape
            (3, P).
        coefficients: Indices of the K coefficients that reach the surface,
            shape (K,).
        transfer: Transfer matrix, shape (K, P).
        albedo: Albedo of the pixels, shape (3, P).
        background_part: What the background contributes to the pixels, shape (P,).
        empty_image: Image of the background alone, shape (3, size²).
    """

    def __init__(self, operator: TransferOperator, background: float):
        size = operator.settings.size
        self.shape = (3, size, size)
        self.pixels = operator.pixels.expand(3, -1)
        self.coefficients = operator.nonzero
        self.transfer = operator.transfer[0]
        self.albedo = operator.albedo
        self.background_part = (1 - operator.coverage) * background
        self.empty_image = operator.coverage.new_full((3, size**2), background)

    def step(self, light: Tensor, loss: Loss) -> tuple[Tensor, Tensor]:
        """Render a light, and compute the gradient of the loss by the light.

        Args:
            light: SH coefficients, shape ((degree + 1)², 3).
            loss: Loss of the image.

        Returns:
            Image, shape (3, size, size), and gradient, shape
            ((degree + 1)², 3).
        """
        reaching = light.index_select(0, self.coefficients).mT
        values = (reaching @ self.transfer).mul_(self.albedo).add_(self.background_part)
        clamped = values.clamp(0, 1)
        # Operations in place reuse the memory of the values.
        is_unclamped = values.eq_(clamped)
        image = self.empty_image.clone()
        image = image.scatter_(1, self.pixels, clamped).view(self.shape)
        image_gradient = loss.gradient(image).reshape(3, -1).gather(1, self.pixels)
        irradiance_gradient = image_gradient.mul_(is_unclamped).mul_(self.albedo)
        reaching_gradient = torch.nn.functional.linear(irradiance_gradient, self.transfer)
        gradient = torch.zeros_like(light)
        gradient.index_copy_(0, self.coefficients, reaching_gradient.mT)
        return image, gradient


def measure_whole_steps(view: View, samples: int, rounds: int) -> list[Row]:
    """Time a whole light step and its preparation in four ways.

    The operator computes the gradient with autograd and directly. The peer and
    the step by hand are compared with the operator.

    Args:
        view: View to render.
        samples: Samples per side of a pixel.
        rounds: Number of rounds.

    Returns:
        Rows of `time_in_turn`, first of the steps and then of the preparations.
    """
    light = coefficients(DEGREE, torch.float32, view.device)
    weights = view.image_gradient.to(light.dtype).view(3, view.size, view.size)
    loss = Loss(weights)
    build_operator = partial(view.operator, samples)
    build_peer = partial(
        Peer,
        view.mesh,
        CAMERA,
        view.size,
        samples,
        DEGREE,
        view.rasterizer,
        BACKGROUND,
        view.device,
    )
    operator = build_operator()
    peer = build_peer()
    operator_image = partial(operator.image, background=BACKGROUND)
    steps: dict[str, WholeStep] = {
        PEER_STEP: AutogradStep(peer.image, light, loss),
        AUTOGRAD_STEP: AutogradStep(operator_image, light, loss),
        DIRECT_STEP: partial(operator.image_and_gradient, light, loss.gradient, BACKGROUND),
        HAND_STEP: partial(ByHand(operator, BACKGROUND).step, light, loss),
    }
    for setting in (AUTOGRAD_STEP, DIRECT_STEP):
        require_close(steps[setting](), steps[PEER_STEP]())
        require_same_bits(steps[setting](), steps[HAND_STEP]())
    builds = {PEER_STEP: build_peer, "operator": build_operator}
    facts = {
        "degree": DEGREE,
        "samples": samples**2,
        "size": view.size,
        "faces": len(view.mesh.faces),
    }
    step_panel = f"whole light step, {view.size}²"
    build_panel = f"building for whole light steps, {view.size}²"
    step_rows = time_in_turn(step_panel, steps, facts, rounds, view.device)
    build_rows = time_in_turn(build_panel, builds, facts, rounds, view.device)
    return step_rows + build_rows


class ManyViews:
    """Whole light steps of many views of a mesh.

    Args:
        mesh: Mesh to render.
        rasterizer: Rasterizer of the views.
        device: Device of the operators.

    Attributes:
        settings: Settings of the images.
        operators: Operators of the V views.
        light: SH coefficients, shape ((degree + 1)², 3).
        loss: Loss of the images of all views.
    """

    def __init__(self, mesh: Mesh, rasterizer: Rasterizer, device: str):
        self.settings = ImageSettings(MANY_VIEWS_SIZE, 2)
        cameras = orbit_cameras(MANY_VIEWS_COUNT, CAMERA.width)
        operators = build_operators(mesh, cameras, self.settings, rasterizer)
        self.operators = TransferOperators(operators).to(device)
        self.light = coefficients(DEGREE, torch.float32, device)
        generator = torch.Generator().manual_seed(0)
        shape = (MANY_VIEWS_COUNT, 3, MANY_VIEWS_SIZE, MANY_VIEWS_SIZE)
        weights = torch.randn(shape, generator=generator)
        self.loss = Loss(weights.to(device))

    def image_by_image(self, light: Tensor) -> Tensor:
        """Render each view by its own operator, shape (V, 3, size, size)."""
        images = [operator.image(light, BACKGROUND) for operator in self.operators]
        return torch.stack(images)

    def step_by_step(self) -> tuple[Tensor, Tensor]:
        """Take a step for each view, and sum the gradients of the steps."""
        images = []
        gradients = []
        for operator, weights in zip(self.operators, self.loss.weights, strict=True):
            render = partial(operator.image, background=BACKGROUND)
            step = AutogradStep(render, self.light, Loss(weights))
            image, gradient = step()
            images.append(image)
            gradients.append(gradient)
        return torch.stack(images), torch.stack(gradients).sum(0)

    def steps(self) -> dict[str, WholeStep]:
        """Return whole steps of all views in a loop, and in one call of all operators."""
        image_of_all = partial(self.operators.image, background=BACKGROUND)
        return {
            LOOP: self.step_by_step,
            "loop over operators, one gradient": AutogradStep(
                self.image_by_image, self.light, self.loss
            ),
            "image of all, and autograd.grad": AutogradStep(image_of_all, self.light, self.loss),
            "image_and_gradient of all": partial(
                self.operators.image_and_gradient, self.light, self.loss.gradient, BACKGROUND
            ),
        }


def measure_many_views(mesh: Mesh, rasterizer: Rasterizer, rounds: int, device: str) -> list[Row]:
    """Time whole light steps of many views, in a loop and in one call.

    Args:
        mesh: Mesh to render.
        rasterizer: Rasterizer of the views.
        rounds: Number of rounds.
        device: Device of the operators.

    Returns:
        Rows of `time_in_turn`.
    """
    views = ManyViews(mesh, rasterizer, device)
    steps = views.steps()
    for step in steps.values():
        require_close(step(), steps[LOOP]())
    facts = {
        "degree": DEGREE,
        "samples": views.settings.samples**2,
        "size": MANY_VIEWS_SIZE,
        "faces": len(mesh.faces),
    }
    panel = f"{MANY_VIEWS_COUNT} views, {MANY_VIEWS_SIZE}²"
    return time_in_turn(panel, steps, facts, rounds, device)


def time_in_turn(
    panel: str, calls: Mapping[str, Call], facts: Row, rounds: int, device: str
) -> list[Row]:
    """Time calls in turns, and compare them with the first call.

    Args:
        panel: Title of the comparison.
        calls: Calls by the names of their settings.
        facts: Further columns, the same in all rows.
        rounds: Number of rounds.
        device: Device that the calls use.

    Returns:
        A row for each call. The columns ratio, ratio_low and ratio_high have
        the median and the quartiles, over the rounds, of the time divided by
        the time of the first call.
    """
    times = times_in_turn(calls, rounds, device)
    first_times = next(iter(times.values()))
    rows = []
    for setting, milliseconds in times.items():
        time_ms = median(milliseconds)
        low, middle, high = quartiles_of_ratio(milliseconds, first_times)
        row: Row = {"panel": panel, "setting": setting, "time_ms": time_ms}
        row |= facts
        row |= {"ratio": middle, "ratio_low": low, "ratio_high": high}
        rows.append(row)
        ratio = f"{middle:.2f} [{low:.2f}, {high:.2f}]"
        print(f"{panel}, {facts}: {setting} {time_ms:.3f} ms, {ratio}")
    return rows


def require_same_bits(values: Sequence[Tensor], expected: Sequence[Tensor]) -> None:
    """Raise AssertionError unless pairs of tensors are equal to the bit.

    Args:
        values: Computed tensors.
        expected: Reference of each tensor.
    """
    for value, expected_value in zip(values, expected, strict=True):
        torch.testing.assert_close(value, expected_value, rtol=0, atol=0)


def require_close(values: Sequence[Tensor], expected: Sequence[Tensor]) -> None:
    """Raise AssertionError unless pairs of tensors differ by rounding of float32 sums alone.

    Args:
        values: Computed tensors.
        expected: Reference of each tensor.
    """
    for value, expected_value in zip(values, expected, strict=True):
        tolerance = 2e-5 * float(expected_value.abs().max())
        torch.testing.assert_close(value, expected_value, rtol=0, atol=tolerance)
