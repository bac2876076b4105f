"""The training loss of a network.

The loss can have a teacher, the network before the training. If only the last layer is trained, the
features before it are the same in both networks, and are computed once.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor, nn

from augment.attacks.objective import is_correct, label_loss
from augment.classifier import log_odds
from augment.network import eval_mode
from renderer.image import to_unit
from train.device import PRECISIONS, MixedPrecision
from train.train_settings import ALL_BUT_LAST, TrainSettings
from train.training.recipe import last_layer


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
        logits = self.model(to_unit(images))
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
            losses = losses * rendered
        loss = losses.mean()
        if teacher_logits is not None:
            divergences = kl_divergence(logits, teacher_logits) * ~rendered
            if self.positive_classes:
                # The training should change the scores of the positive classes of renders.
                classes = torch.arange(logits.shape[1], device=logits.device)
                is_other = torch.stack([classes != one for one in self.positive_classes]).all(0)
                others, targets = logits[:, is_other], teacher_logits[:, is_other]
                divergences = divergences + kl_divergence(others, targets) * rendered
            loss = loss + settings.distillation_weight * divergences.mean()
        if teacher_logits is not None and augmented is not None:
            augmented_logits = self.model(to_unit(augmented))
            divergences = kl_divergence(augmented_logits, teacher_logits) * ~rendered
            loss = loss + settings.consistency_weight * divergences.mean()
        if self.positive_classes and settings.ranking_weight:
            loss_sum = sum(ranking_loss(logits, labels, label) for label in self.positive_classes)
            loss = loss + settings.ranking_weight * loss_sum / len(self.positive_classes)
        hits = is_correct(logits.detach().argmax(1), labels, other_positives).sum()
        return loss, hits


def ranking_loss(
    logits: Float[Tensor, "N classes"], labels: Int[Tensor, " N"], label: int
) -> Tensor:
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


def kl_divergence(
    logits: Float[Tensor, "N classes"], predictions: Float[Tensor, "N classes"]
) -> Float[Tensor, " N"]:
    """Compute the distillation loss (Hinton et al. 2015) at temperature 1.

    It is the Kullback–Leibler divergence Σ q log(q / p), summed over the classes, where p are the
    probabilities of the student and q are those of the teacher.
    """
    student = logits.log_softmax(1)
    teacher = predictions.log_softmax(1)
    terms = F.kl_div(student, teacher, reduction="none", log_target=True)
    return terms.sum(1)


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
        self.features = inputs[0].detach()

    def forward(self, images: Float[Tensor, "B 3 H W"]) -> Float[Tensor, "B classes"]:
        """Return the logits of the teacher for the images with which the pupil was called last."""
        is_mixed = self._dtype != torch.float32
        with torch.autocast(images.device.type, self._dtype, enabled=is_mixed):
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
    if not is_frozen or has_script:
        return teacher
    shared = SharedTeacher(pupil, teacher)
    # Two test images with a color gradient.
    device = next(teacher.parameters()).device
    images = torch.linspace(0, 1, 6 * size**2, device=device).view(2, 3, size, size)
    with eval_mode(pupil), torch.no_grad():
        expected = teacher(images)
        is_equal = pupil(images).equal(expected) and shared.features is not None
        if is_equal and shared(images).equal(expected):
            return shared
    shared.hook.remove()
    return teacher
