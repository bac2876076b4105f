"""The recipe of a training: loss, optimizer, learning rate, and frozen layers.

The loss can have a teacher, the network before the training. If only the last layer is trained, the
features before it are the same in both networks, and are computed once.
"""

import math
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from statistics import fmean
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor, nn

from augment.network import device_of, eval_mode, keep_text_vectors, plain_outputs, text_vectors
from augment.tasks.classification import is_correct, label_loss, log_odds, nearest
from renderer.errors import MAX_SCALE, InputError
from renderer.image import to_unit
from train.device import PRECISIONS, MixedPrecision
from train.settings import ALL_BUT_LAST, TrainSettings

# The schedule "one_cycle" begins with this fraction of the highest learning rate, and
# reaches the highest learning rate after the fraction WARMUP of the training.
START_FACTOR = 0.1
WARMUP = 0.2
# Modules whose outputs differ in training mode: by statistics of the batch, or at random.
RANDOM = (nn.modules.batchnorm._BatchNorm, nn.modules.dropout._DropoutNd)

Logits = Float[Tensor, "N classes"]
# Names of layers with their outputs.
Outputs = list[tuple[str, Any]]


def learning_rate(settings: TrainSettings, done: float) -> float:
    """Compute the learning rate at a time of the training.

    `done` is the fraction of the training that is done. In the schedule "one_cycle", the rate
    rises linearly to the highest rate, and then falls to 0.
    """
    if settings.schedule == "step":
        # The fractions are those of Zagoruyko and Komodakis (2016).
        factor = 0.2 ** sum(done >= milestone for milestone in (0.3, 0.6, 0.8))
    elif settings.schedule == "cosine":
        factor = (1 + math.cos(math.pi * done)) / 2
    # The schedule "one_cycle": a linear rise, and then a linear fall to 0.
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
    rate, decay = settings.learning_rate, settings.weight_decay
    if settings.optimizer == "sgd":
        options: dict[str, Any] = {"momentum": settings.momentum, "weight_decay": decay}
        options["nesterov"] = settings.momentum > 0
        return torch.optim.SGD(model.parameters(), rate, fused=True, **options)
    # Biases and the weights of normalization layers are vectors.
    vectors = [parameter for parameter in model.parameters() if parameter.ndim <= 1]
    matrices = [parameter for parameter in model.parameters() if parameter.ndim > 1]
    groups = [{"params": vectors, "weight_decay": 0.0}, {"params": matrices, "weight_decay": decay}]
    return torch.optim.AdamW(groups, rate, fused=True)


def last_layer(network: nn.Module) -> str:
    """Return the name of the module that has the last parameter which is not frozen.

    It is empty if the network itself is this module.
    """
    names = [name for name, parameter in network.named_parameters() if parameter.requires_grad]
    return _module_of(names[-1])


def called_layers(network: nn.Module, size: int, count: int = 1) -> tuple[Outputs, Any]:
    """Return the layers with matrices in the order of their calls, and the outputs of the network.

    Each layer has its name and its output for so many gray images. The order of the calls may
    differ from the order of the parameters, which is that of the definitions. Normalizations and
    activations with parameters do not count, unless a network has no other layer. A network of
    TorchScript or torch.export calls no modules.
    """
    called: Outputs = []
    matrices: Outputs = []

    def note(name: str, layer: nn.Module, _: Any, output: Any) -> None:
        called.append((name, output))
        if any(parameter.ndim > 1 for parameter in layer.parameters()):
            matrices.append((name, output))

    images = torch.full((count, 3, size, size), 0.5, device=device_of(network))
    with ExitStack() as hooks, eval_mode(network), torch.no_grad():
        for name, module in network.named_modules():
            # A layer has parameters itself, and contains no module with others.
            is_layer = {_module_of(parameter) for parameter, _ in module.named_parameters()} == {""}
            if is_layer and not isinstance(module, torch.jit.ScriptModule):
                hooks.enter_context(module.register_forward_hook(partial(note, name)))
        outputs = plain_outputs(network(images))
    return matrices or called, outputs


def _module_of(parameter: str) -> str:
    """Return the name of the module of a parameter: "head.fc" for "head.fc.weight".

    The module of the parametrized weight "head.fc.parametrizations.weight.original" is "head.fc".
    """
    return parameter.partition("parametrizations.")[0].rpartition(".")[0]


def freeze(network: nn.Module, stage: str, size: int) -> None:
    """Freeze the parameters of a network from its first parameter to the last one of a module.

    The stage "all_but_last" leaves only the layer that the network calls last or, of a zero-shot
    network, the vectors of its texts.
    """
    if stage == ALL_BUT_LAST:
        called, logits = called_layers(network, size)
        class_count = logits.shape[1]
        last = called[-1][0] if called else last_layer(network)
        # A weight that several modules share has several names.
        named = network.named_parameters(remove_duplicate=False)
        weights = {weight for name, weight in named if _module_of(name) == last}
        # The last layer of a classifier has a row for each class, that of a zero-shot network none.
        is_zero_shot = not any(class_count in weight.shape for weight in weights)
        texts = text_vectors(network, class_count)[-1:] if is_zero_shot else []
        # The vectors of the texts become parameters, which can learn.
        if texts:
            keep_text_vectors(network, class_count, nn.Parameter)
        for name, parameter in network.named_parameters():
            parameter.requires_grad_(name in texts if texts else parameter in weights)
        return
    names = [name for name, _ in network.named_parameters()]
    chosen = [name for name in names if name.startswith(f"{stage}.")]
    if not chosen or chosen[-1] == names[-1]:
        fault = "leaves no layer that learns" if chosen else "is no module"
        examples = nearest(stage, sorted({*map(_module_of, names)} - {_module_of(names[-1])}))
        raise InputError(f"stage={stage} {fault}: choose one, such as {examples}", "stage")
    # All parameters up to the last one of the stage are frozen.
    for parameter in list(network.parameters())[: names.index(chosen[-1]) + 1]:
        parameter.requires_grad_(False)


def set_training_mode(network: nn.Module, settings: TrainSettings, returns_losses: bool) -> None:
    """Put a network in training mode, except the modules that should not change.

    Modules of frozen parameters stay in evaluation mode, so that the statistics
    of their batch normalization do not change either. With the setting `eval_mode`, no module is in
    training mode or, if the network `returns_losses` in this mode, no module of RANDOM.
    """
    network.train(returns_losses or not settings.eval_mode)
    for module in network.modules():
        parameters = list(module.parameters())
        is_frozen = parameters and not any(parameter.requires_grad for parameter in parameters)
        if is_frozen or (settings.eval_mode and isinstance(module, RANDOM)):
            module.eval()


def scale_learning_rate(settings: TrainSettings, network: nn.Module, images: Tensor) -> float:
    """Adapt the learning rate of the last layer to the norm of its features.

    A step with a clipped gradient changes the weights of the layer by at most
    the learning rate. It then changes a logit by at most the learning rate
    times the norm of the features. With the adapted rate, this product is the
    same for all networks. It is not adapted if more than this layer learns, or without the setting
    `feature_norm`.
    """
    wanted = settings.feature_norm
    if wanted is None or settings.freeze != ALL_BUT_LAST:
        return settings.learning_rate
    norm = feature_norm(network, images)
    # rate · norm = learning_rate · feature_norm, which is the same for all networks.
    rate = settings.learning_rate * wanted / norm if norm else math.inf
    if not 0 < rate <= MAX_SCALE:
        fault = f"feature_norm={wanted:g}, but the features of the last layer have norm {norm:g}"
        raise InputError(f"{fault}: check the weights, or set null", "feature_norm")
    return rate


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
    # The matrix of the layer, without its bias.
    weights = [one for one in layer.parameters() if one.ndim > 1 and one.requires_grad]
    squares = []
    with eval_mode(network):
        for image in images.split(1):
            # The logit of the predicted class is the largest one.
            logit = network(image).max()
            if not (weights and logit.requires_grad):
                fault = f"freeze={ALL_BUT_LAST}: the last layer, {name!r}, has no gradient"
                raise InputError(f"{fault}: name the last module that stays as it is", "freeze")
            gradients = torch.autograd.grad(logit, weights)
            squares.append(sum(float(gradient.square().sum()) for gradient in gradients))
        # Some weights are computed in each pass (`torch.nn.utils.weight_norm`). After this pass
        # without gradients, they have no graph, with which the network could not be copied.
        with torch.no_grad():
            network(images[:1])
    return math.sqrt(fmean(squares))


@dataclass
class TrainingLoss:
    """Loss of a network on a batch of training images, some of which are renders.

    It is the mean cross entropy of the labels, plus three terms whose weights are in the settings:

    - ranking: images of a positive class should have a higher score of this class than others;
    - distillation: divergence of the predictions from those of a teacher, the network before the
      training;
    - consistency: divergence of the predictions for augmented images from the predictions of the
      teacher for the same images without augmentation.

    If not `labeled`, only renders count in the cross entropy, and for other images the
    predictions of the teacher are the correct ones.
    """

    model: nn.Module
    settings: TrainSettings
    positive_classes: Sequence[int]
    teacher: nn.Module | None
    labeled: bool = True

    @property
    def learns_unchanged(self) -> bool:
        """Whether the network learns from images before the augmentation, too."""
        # Without labels, renders and distillation, only the augmented photographs are learned.
        return bool(self.labeled or self.positive_classes or self.settings.distillation_weight)

    def compute(
        self,
        images: UInt8[Tensor, "B 3 H W"],
        labels: Int[Tensor, " B"],
        rendered: Bool[Tensor, " B"],
        augmented: UInt8[Tensor, "B 3 H W"] | None = None,
    ) -> tuple[Float[Tensor, ""], Int[Tensor, ""]]:
        """Compute the loss of a batch.

        A negative label says of which class the image is not. Return the loss and the number of
        correct predictions.
        """
        settings = self.settings
        shown = images if augmented is None or self.learns_unchanged else augmented
        logits = self.model(to_unit(shown))
        teacher_logits = None
        if self.teacher is not None:
            with torch.no_grad():
                teacher_logits = self.teacher(to_unit(images))
            # Without labels, a photograph has the class that the teacher predicts.
            if not self.labeled:
                labels = torch.where(rendered, labels, teacher_logits.argmax(1))

        # A complementary label (below 0) says that an image is not of the first positive
        # class. Such an image is not of the other positive classes either.
        other_positives = self.positive_classes[1:]
        losses = label_loss(logits, labels, settings.label_smoothing, other_positives)
        if not self.labeled:
            # Photographs without labels have no label loss, only the divergence from the teacher.
            losses = losses * rendered
        loss = losses.mean()
        if teacher_logits is not None:
            # On photographs, all logits stay close to those of the teacher.
            divergences = kl_divergence(logits, teacher_logits) * ~rendered
            if self.positive_classes:
                # The training should change the scores of the positive classes of renders.
                classes = torch.arange(logits.shape[1], device=logits.device)
                is_other = torch.stack([classes != one for one in self.positive_classes]).all(0)
                others, targets = logits[:, is_other], teacher_logits[:, is_other]
                divergences = divergences + kl_divergence(others, targets) * rendered
            loss = loss + settings.distillation_weight * divergences.mean()
        if teacher_logits is not None and augmented is not None:
            # Also augmented photographs should get the predictions for the originals.
            relit = logits if shown is augmented else self.model(to_unit(augmented))
            divergences = kl_divergence(relit, teacher_logits) * ~rendered
            loss = loss + settings.consistency_weight * divergences.mean()
        if self.positive_classes and settings.ranking_weight:
            loss_sum = sum(ranking_loss(logits, labels, label) for label in self.positive_classes)
            loss = loss + settings.ranking_weight * loss_sum / len(self.positive_classes)
        return loss, is_correct(logits.detach().argmax(1), labels, other_positives).sum()


def ranking_loss(logits: Logits, labels: Int[Tensor, " N"], label: int) -> Tensor:
    """Compute the pairwise ranking loss of a class (RankNet, Burges et al. 2005).

    It is low if the images of the class have higher log-odds than all other images. It is the mean
    of log(1 + exp(n − p)) over all pairs of an image of the class, with log-odds p, and an image of
    another class, with log-odds n. Up to a factor, it is a smooth upper bound of 1 − AUC. Labels
    are classes, and the loss is 0 if there is no pair.
    """
    odds = log_odds(logits, label)
    is_of_class = labels == label
    # Rows are images of the class, columns are images of other classes, shape (N, N).
    is_pair = is_of_class[:, None] & ~is_of_class[None, :]
    losses = F.softplus(odds[None, :] - odds[:, None]) * is_pair
    return losses.sum() / is_pair.sum().clamp(min=1)


def kl_divergence(logits: Logits, predictions: Logits) -> Float[Tensor, " N"]:
    """Compute the distillation loss (Hinton et al. 2015) at temperature 1.

    It is the Kullback–Leibler divergence Σ q log(q / p), summed over the classes, where p are the
    probabilities of the student and q are those of the teacher.
    """
    student, teacher = logits.log_softmax(1), predictions.log_softmax(1)
    return F.kl_div(student, teacher, reduction="none", log_target=True).sum(1)


class SharedTeacher(nn.Module):
    """Teacher that applies its last layer to the features of its pupil, the network in training.

    The teacher is a copy of the pupil before the training, in which only the last layer changes.
    The pupil must be called before each call of the teacher, with the same images.
    """

    def __init__(self, pupil: MixedPrecision, teacher: MixedPrecision):
        """Store what the last layer of the pupil gets as its input, whenever it is called."""
        super().__init__()
        name = last_layer(pupil.network)
        self.layer = teacher.network.get_submodule(name)
        self.features: Tensor | None = None
        self._dtype = PRECISIONS[teacher.precision]
        layer = pupil.network.get_submodule(name)
        self.hook = layer.register_forward_pre_hook(self._store_features)

    def _store_features(self, _: nn.Module, inputs: tuple[Any, ...]) -> None:
        self.features = inputs[0].detach() if inputs else None

    def forward(self, images: Float[Tensor, "B 3 H W"]) -> Float[Tensor, "B classes"]:
        """Return the logits of the teacher for the images with which the pupil was called last."""
        with torch.autocast(images.device.type, self._dtype, enabled=self._dtype != torch.float32):
            return self.layer(self.features).float()


def share_layers(
    settings: TrainSettings, pupil: MixedPrecision, teacher: MixedPrecision, size: int
) -> nn.Module:
    """Return a teacher that shares layers with its pupil, if that does not change its logits.

    They are shared if only the last layer learns, and if the logits for two test images stay equal.
    """
    # The features would depend on the statistics of the batch in training mode.
    is_frozen = settings.freeze == ALL_BUT_LAST and settings.eval_mode
    # `SharedTeacher` registers a hook, which modules of TorchScript do not support.
    has_script = any(isinstance(module, torch.jit.ScriptModule) for module in pupil.modules())
    # The features change if an earlier layer shares a weight with the last one.
    is_tied = len([*pupil.parameters()]) < len([*pupil.named_parameters(remove_duplicate=False)])
    if not is_frozen or has_script or is_tied:
        return teacher
    shared = SharedTeacher(pupil, teacher)
    # Two test images with a color gradient.
    images = torch.linspace(0, 1, 6 * size**2, device=device_of(teacher)).view(2, 3, size, size)
    with eval_mode(pupil), torch.no_grad():
        expected = teacher(images)
        is_equal = pupil(images).equal(expected) and shared.features is not None
        if is_equal and shared(images).equal(expected):
            return shared
    shared.hook.remove()
    return teacher
