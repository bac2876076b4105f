"""Build the optimizer, compute the learning rate, and freeze layers."""

import math
from statistics import fmean

import torch
from jaxtyping import Float
from torch import Tensor, nn

from augment.classifier import nearest
from augment.network import eval_mode
from renderer.errors import InputError
from train.train_settings import ALL_BUT_LAST, TrainSettings

# The schedule "step" multiplies the learning rate by STEP_FACTOR after each of these
# fractions of the training, like Zagoruyko and Komodakis (2016).
MILESTONES = (0.3, 0.6, 0.8)
STEP_FACTOR = 0.2
# The schedule "one_cycle" begins with this fraction of the highest learning rate, and
# reaches the highest learning rate after the fraction WARMUP of the training.
START_FACTOR = 0.1
WARMUP = 0.2


def learning_rate(settings: TrainSettings, done: float) -> float:
    """Compute the learning rate at a time of the training.

    `done` is the fraction of the training that is done. In the schedule "one_cycle", the rate
    rises linearly to the highest rate, and then falls to 0.
    """
    if settings.schedule == "step":
        factor = STEP_FACTOR ** sum(done >= milestone for milestone in MILESTONES)
    elif settings.schedule == "cosine":
        factor = (1 + math.cos(math.pi * done)) / 2
    elif done < WARMUP:
        factor = START_FACTOR + (1 - START_FACTOR) * done / WARMUP
    else:
        factor = (1 - done) / (1 - WARMUP)
    return settings.learning_rate * factor


def build_optimizer(model: nn.Module, settings: TrainSettings) -> torch.optim.Optimizer:
    """Build the optimizer of a network.

    "sgd" has Nesterov momentum, and weight decay for all parameters, as in the
    paper. "adamw" (Loshchilov and Hutter 2019) ignores `settings.momentum`, and
    has no weight decay for biases and normalization layers, as is usual.
    """
    if settings.optimizer == "sgd":
        return torch.optim.SGD(
            model.parameters(),
            settings.learning_rate,
            momentum=settings.momentum,
            weight_decay=settings.weight_decay,
            nesterov=settings.momentum > 0,
            fused=True,
        )
    # Biases and the weights of normalization layers are vectors.
    vectors = [parameter for parameter in model.parameters() if parameter.ndim <= 1]
    matrices = [parameter for parameter in model.parameters() if parameter.ndim > 1]
    groups = [
        {"params": vectors, "weight_decay": 0.0},
        {"params": matrices, "weight_decay": settings.weight_decay},
    ]
    return torch.optim.AdamW(groups, settings.learning_rate, fused=True)


def last_layer(network: nn.Module) -> str:
    """Return the name of the module that has the last parameter which is not frozen.

    It is empty if the network itself is this module.
    """
    names = [name for name, parameter in network.named_parameters() if parameter.requires_grad]
    return _module_of(names[-1])


def _last_called_layer(network: nn.Module, size: int) -> str:
    """Return the name of the layer with a matrix or kernels that a network calls last.

    The order of the calls may differ from the order of the parameters, which is
    that of the definitions. Normalizations and activations with parameters do not
    count, unless a network has no other layer. A network of TorchScript or torch.export calls no
    modules, so the module of its last parameter is returned.
    """
    called: list[tuple[bool, str]] = []
    hooks = []
    for name, module in network.named_modules():
        own = list(module.parameters(recurse=False))
        is_layer = own and len(own) == len(list(module.parameters()))
        if is_layer and not isinstance(module, torch.jit.ScriptModule):
            call = (any(parameter.ndim > 1 for parameter in own), name)
            hooks.append(module.register_forward_hook(lambda *_, call=call: called.append(call)))
    device = next(network.parameters()).device
    with eval_mode(network), torch.no_grad():
        network(torch.full((1, 3, size, size), 0.5, device=device))
    for hook in hooks:
        hook.remove()
    names = [name for has_matrix, name in called if has_matrix] or [name for _, name in called]
    return names[-1] if names else last_layer(network)


def _module_of(parameter: str) -> str:
    """Return the name of the module of a parameter: "head.fc" for "head.fc.weight"."""
    return parameter.rpartition(".")[0]


def freeze(network: nn.Module, stage: str, size: int) -> None:
    """Freeze the parameters of a network from its first parameter to the last one of a module.

    The stage "all_but_last" leaves only the layer that the network calls last.
    """
    if next(network.parameters(), None) is None:
        raise InputError("the network has no parameters: give a network that can be trained")
    if stage == ALL_BUT_LAST:
        last = _last_called_layer(network, size)
        for name, parameter in network.named_parameters():
            parameter.requires_grad_(_module_of(name) == last)
        return
    names = [name for name, _ in network.named_parameters()]
    chosen = [name for name in names if name.startswith(f"{stage}.")]
    if not chosen:
        examples = nearest(stage, sorted({_module_of(name) for name in names}))
        raise InputError(
            f"stage={stage} is no module of the network: choose a module, such as {examples}",
            "stage",
        )
    frozen_count = names.index(chosen[-1]) + 1
    for parameter in list(network.parameters())[:frozen_count]:
        parameter.requires_grad_(False)


def set_training_mode(network: nn.Module, settings: TrainSettings) -> None:
    """Put a network in training mode, except the modules that should not change.

    Modules of frozen parameters stay in evaluation mode, so that the statistics
    of their batch normalization do not change either. With the setting `eval_mode`, no module is in
    training mode.
    """
    network.train(not settings.eval_mode)
    for module in network.modules():
        parameters = list(module.parameters())
        if parameters and not any(parameter.requires_grad for parameter in parameters):
            module.eval()


def scale_learning_rate(
    settings: TrainSettings, network: nn.Module, images: Float[Tensor, "N 3 H W"]
) -> float:
    """Adapt the learning rate of the last layer to the norm of its features.

    A step with a clipped gradient changes the weights of the layer by at most
    the learning rate. It then changes a logit by at most the learning rate
    times the norm of the features. With the adapted rate, this product is the
    same for all networks. It is not adapted if more than this layer learns, or without the setting
    `feature_norm`.
    """
    if settings.feature_norm is None or settings.freeze != ALL_BUT_LAST:
        return settings.learning_rate
    norm = feature_norm(network, images)
    if not 0 < norm < math.inf:
        raise InputError(
            f"feature_norm={settings.feature_norm:g} has no meaning for this network, since the "
            f"norm of the features of its last layer is {norm:g}: check the weights, or set "
            "feature_norm=null",
            "feature_norm",
        )
    return settings.learning_rate * settings.feature_norm / norm


def feature_norm(network: nn.Module, images: Float[Tensor, "N 3 H W"]) -> float:
    """Compute the root mean square norm of the features that the last layer of a network gets.

    For a linear layer, the features of an image are the gradient of a logit with
    respect to its weights. This gradient is computed for the predicted class. For
    a convolution whose outputs are averaged, as in SqueezeNet, it is the mean of
    the features over the positions. The gradient also exists for networks of
    TorchScript and torch.export, in which no hook can read the features.
    """
    name = last_layer(network)
    layer = network.get_submodule(name)
    weights = [parameter for parameter in layer.parameters() if parameter.ndim > 1]
    squares = []
    with eval_mode(network):
        for image in images.split(1):
            logit = network(image).max()
            if not (weights and logit.requires_grad):
                raise InputError(
                    f"freeze={ALL_BUT_LAST}: the logits do not depend on weights of the last "
                    f"layer, {name!r}, by gradients: name the last module that stays as it is",
                    "freeze",
                )
            gradients = torch.autograd.grad(logit, weights)
            squares.append(sum(float(gradient.square().sum()) for gradient in gradients))
    return math.sqrt(fmean(squares))
