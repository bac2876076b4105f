"""The loss that a network is trained with."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from augment.losses import is_correct, kl_divergence, label_loss, ranking_loss
from renderer.image import to_unit
from train.settings import TrainSettings


class TrainingLoss:
    """The loss of a batch of images, some of which are renders.

    The loss is the mean of the label loss plus three terms, each with a weight
    in the settings:

    - the ranking loss of the positive classes;
    - distillation: the divergence of the predictions from those of a teacher;
    - consistency: the divergence of the predictions for augmented images from
      the predictions of the teacher for the same images without augmentation.

    Args:
        model: The network, from images in [0, 1] to logits.
        settings: The settings, with the weights of the terms.
        positive_classes: Indices of the positive classes, which the ranking
            loss ranks against the others. Empty without a ranking loss.
        teacher: The network whose predictions are kept. None without distillation and consistency.
        labeled: Whether the labels of the data are known. Otherwise only renders have a label
            loss, and the teacher's predictions are the labels of all other images.
    """

    def __init__(
        self,
        model: nn.Module,
        settings: TrainSettings,
        positive_classes: Sequence[int],
        teacher: nn.Module | None,
        labeled: bool = True,
    ):
        self._model = model
        self._settings = settings
        self._positive_classes = positive_classes
        self._teacher = teacher
        self._labeled = labeled

    def compute(
        self,
        images: Tensor,
        labels: Tensor,
        rendered: Tensor,
        augmented: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Compute the loss of a batch.

        Args:
            images: The images, uint8, shape (B, 3, H, W).
            labels: Their classes, shape (B,).
            rendered: Which of them are renders, bool, shape (B,).
            augmented: The images after an augmentation, for the consistency
                term. None without this term.

        Returns:
            The loss, a scalar, and the number of correct predictions.
        """
        settings = self._settings
        logits = self._model(to_unit(images))
        targets = None
        if self._teacher is not None:
            with torch.no_grad():
                targets = self._teacher(to_unit(images))
            if not self._labeled:
                labels = torch.where(rendered, labels, targets.argmax(1))

        # The first class is the one that a complementary label leaves out.
        others = self._positive_classes[1:]
        losses = label_loss(logits, labels, settings.label_smoothing, others)
        if not self._labeled:
            losses = losses * rendered
        loss = losses.mean()
        if targets is not None:
            changes = self._changes(logits, targets, rendered)
            loss = loss + settings.distillation_weight * changes.mean()
        if targets is not None and augmented is not None:
            answers = self._model(to_unit(augmented))
            changes = kl_divergence(answers, targets) * ~rendered
            loss = loss + settings.consistency_weight * changes.mean()
        if self._positive_classes and settings.ranking_weight:
            ranked = sum(ranking_loss(logits, labels, label) for label in self._positive_classes)
            loss = loss + settings.ranking_weight * ranked / len(self._positive_classes)
        hits = is_correct(logits.detach().argmax(1), labels, others).sum()
        return loss, hits

    def _changes(self, logits: Tensor, targets: Tensor, rendered: Tensor) -> Tensor:
        """Compute how far the predictions are from those of the teacher.

        The predictions for renders may change in the positive classes, so only
        the other classes of renders are compared. Without positive classes,
        renders have the divergence 0.

        Args:
            logits: Logits of the network, shape (B, classes).
            targets: Logits of the teacher, shape (B, classes).
            rendered: Which of the images are renders, bool, shape (B,).

        Returns:
            Kullback-Leibler divergence of each image, shape (B,).
        """
        changes = kl_divergence(logits, targets) * ~rendered
        if self._positive_classes:
            classes = torch.arange(logits.shape[1], device=logits.device)
            is_kept = torch.stack([classes != label for label in self._positive_classes]).all(0)
            changes = changes + kl_divergence(logits[:, is_kept], targets[:, is_kept]) * rendered
        return changes
