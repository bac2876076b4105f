"""The training loss of a network."""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor, nn

from augment.attacks.objective import is_correct, label_loss
from augment.classifier import log_odds
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
