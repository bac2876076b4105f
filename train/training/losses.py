"""The training loss of a network."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor, nn

from augment.losses import is_correct, kl_divergence, label_loss, ranking_loss
from renderer.image import to_unit
from train.train_settings import TrainSettings


class TrainingLoss:
    """Loss of a network on a batch of training images, some of which are renders.

    It is the mean cross entropy of the labels, plus three terms whose weights are in the settings:

    - ranking: images of a positive class should have a higher score of this class than others;
    - distillation: divergence of the predictions from those of a teacher, the network before the
      training;
    - consistency: divergence of the predictions for augmented images from the predictions of the
      teacher for the same images without augmentation.
    """

    def __init__(
        self,
        model: nn.Module,
        settings: TrainSettings,
        positive_classes: Sequence[int],
        teacher: nn.Module | None,
        labeled: bool = True,
    ):
        """Store the arguments.

        If not `labeled`, only renders count in the cross entropy, and for other images the
        predictions of the teacher are the correct ones.
        """
        self._model = model
        self._settings = settings
        self._positive_classes = positive_classes
        self._teacher = teacher
        self._labeled = labeled

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
        settings = self._settings
        logits = self._model(to_unit(images))
        teacher_logits = None
        if self._teacher is not None:
            with torch.no_grad():
                teacher_logits = self._teacher(to_unit(images))
            # Without labels, a photograph has the class that the teacher predicts.
            if not self._labeled:
                labels = torch.where(rendered, labels, teacher_logits.argmax(1))

        # A complementary label (below 0) says that an image is not of the first positive
        # class. Such an image is not of the other positive classes either.
        other_positives = self._positive_classes[1:]
        losses = label_loss(logits, labels, settings.label_smoothing, other_positives)
        if not self._labeled:
            losses = losses * rendered
        loss = losses.mean()
        if teacher_logits is not None:
            divergences = self._divergences(logits, teacher_logits, rendered)
            loss = loss + settings.distillation_weight * divergences.mean()
        if teacher_logits is not None and augmented is not None:
            augmented_logits = self._model(to_unit(augmented))
            divergences = kl_divergence(augmented_logits, teacher_logits) * ~rendered
            loss = loss + settings.consistency_weight * divergences.mean()
        if self._positive_classes and settings.ranking_weight:
            loss_sum = sum(ranking_loss(logits, labels, label) for label in self._positive_classes)
            loss = loss + settings.ranking_weight * loss_sum / len(self._positive_classes)
        hits = is_correct(logits.detach().argmax(1), labels, other_positives).sum()
        return loss, hits

    def _divergences(
        self,
        logits: Float[Tensor, "B classes"],
        targets: Float[Tensor, "B classes"],
        rendered: Bool[Tensor, " B"],
    ) -> Float[Tensor, " B"]:
        """Compute the divergence of the predictions from those of the teacher.

        For renders, only the classes that are not positive are compared, because
        the training should change the scores of the positive classes. Without
        positive classes, the divergence of renders is 0.
        """
        divergences = kl_divergence(logits, targets) * ~rendered
        if self._positive_classes:
            classes = torch.arange(logits.shape[1], device=logits.device)
            # Whether each class is not a positive class, shape (classes,).
            is_other = torch.stack([classes != label for label in self._positive_classes]).all(0)
            of_renders = kl_divergence(logits[:, is_other], targets[:, is_other]) * rendered
            divergences = divergences + of_renders
        return divergences
