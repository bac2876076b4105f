"""Modes of torch in which renders are computed: without autocast and second derivatives."""

from collections.abc import Callable
from functools import wraps
from typing import Any, ParamSpec, TypeVar

import torch
from torch import Tensor

P = ParamSpec("P")
R = TypeVar("R")


def without_autocast(function: Callable[P, R]) -> Callable[P, R]:
    """Decorate a function that computes in the precision of its tensors, also in autocast."""

    @wraps(function)
    def called(*args: P.args, **options: P.kwargs) -> R:
        # A context manager in each call would take a tenth of a lighting step.
        if not (torch.is_autocast_enabled("cpu") or torch.is_autocast_enabled("cuda")):
            return function(*args, **options)
        with torch.autocast("cpu", enabled=False), torch.autocast("cuda", enabled=False):
            return function(*args, **options)

    return called


def once_differentiable(backward: Callable[..., Any]) -> Callable[..., Any]:
    """Decorate the backward pass of a function whose gradient has no gradient itself.

    The decorator of this name in torch returns zeros instead of an error if a gradient is asked for
    with respect to inputs by name, or if the incoming gradient has none.
    """

    @wraps(backward)
    @without_autocast
    def called(ctx: Any, *upstream: Any) -> Any:
        if not torch.is_grad_enabled():
            return backward(ctx, *upstream)
        with torch.no_grad():
            gradients = backward(ctx, *upstream)
        given = [value for value in (*upstream, *ctx.saved_tensors) if isinstance(value, Tensor)]
        inputs = [value for value in given if value.requires_grad]
        if isinstance(gradients, Tensor):
            return _Refusal.apply(gradients, *inputs)
        return tuple(each if each is None else _Refusal.apply(each, *inputs) for each in gradients)

    return called


class _Refusal(torch.autograd.Function):
    """The first argument, whose gradient with respect to the others is an error."""

    @staticmethod
    def forward(_: Any, gradient: Tensor, *inputs: Tensor) -> Tensor:
        """Return the gradient."""
        return gradient.view_as(gradient)

    @staticmethod
    def backward(_: Any, *upstream: Tensor) -> Any:
        """Refuse to compute second derivatives."""
        advice = "use finite differences of gradients"
        raise RuntimeError(f"renders have no second derivatives: {advice}")
