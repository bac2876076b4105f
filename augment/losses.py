"""Losses: the cost that an attack decreases, and the losses of training.

A label is the index of a class. A complementary label says that an image does not show a class. It
is the number −1 − class. If there are several positive classes, the argument `absent` contains the
other classes that images with a complementary label do not show, either.
"""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from renderer.errors import require_range

# Index that stands for "no class" in attacks without a source or a target class. It differs from
# all labels.
NO_CLASS = -(10**9)
# A network is overconfident where its log-odds exceed this number. Networks rarely do so, unless
# their logits are multiplied by a factor.
OVERCONFIDENT = 50.0


def adversarial_cost(
    logits: Float[Tensor, "N classes"],
    source: Int[Tensor, " N"],
    target: Int[Tensor, " N"] | None = None,
) -> Float[Tensor, " N"]:
    """Compute the cost that an attack decreases.

    It is −CE(logits, source) + CE(logits, target), where CE is the cross entropy. Without a target,
    the cost and its gradient round to 0 if the log-odds o of the source are large. Where they
    exceed 50, o − 50 is therefore added. The attack lowers the probability of the source class and
    raises that of the target class. `NO_CLASS` omits a term of an image, and a target of None omits
    it for all images.
    """
    # `require_known` refuses NO_CLASS, which is negative. `clamp` replaces it by class 0.
    require_known(source.clamp(min=0), logits)
    odds = _log_odds(logits, source)
    is_added = odds > OVERCONFIDENT
    if target is not None:
        is_added = is_added & (target == NO_CLASS)
    cost = F.logsigmoid(odds) + torch.where(is_added, odds - OVERCONFIDENT, 0)
    cost = torch.where(source == NO_CLASS, 0, cost)
    if target is not None:
        cost = cost + F.cross_entropy(logits, target, reduction="none", ignore_index=NO_CLASS)
    return cost


def _log_odds(logits: Tensor, classes: Tensor) -> Tensor:
    """Compute the log-odds of a class of each image, where NO_CLASS stands for any class.

    Their log σ is the logarithm of the probability. Its gradient is accurate even if the
    probability rounds to 1. The gradient of `cross_entropy` then loses the term of the class.
    """
    columns = torch.where(classes == NO_CLASS, 0, classes)[:, None]
    other_logits = logits.scatter(1, columns, -torch.inf)
    return logits.gather(1, columns)[:, 0] - other_logits.logsumexp(1)


def is_overconfident(logits: Float[Tensor, "... classes"]) -> Bool[Tensor, " ..."]:
    """Return a mask of the images with a class of log-odds above 50 or below −50."""
    lowest, highest = logits.aminmax(dim=-1)
    return highest - lowest > OVERCONFIDENT


def logit_gap(
    logits: Float[Tensor, "... classes"],
    source: Int[Tensor, " ..."],
    target: Int[Tensor, " ..."] | None = None,
) -> Float[Tensor, " ..."]:
    """Compute by how much logits reach the aim of an attack.

    With a target class, the logit gap is the logit of the target minus the largest other logit.
    Without one, it is the largest logit of the other classes minus the logit of the source class.
    It is positive if the attack succeeds, and negative if it does not. A target of `NO_CLASS`
    stands for no target of an image, and None for none of all images.
    """
    if target is None:
        target = torch.full_like(source, NO_CLASS)
    has_target = target != NO_CLASS
    # Class whose logit is compared with the others, shape (..., 1).
    compared_class = torch.where(has_target, target, source)[..., None]
    compared_logit = logits.gather(-1, compared_class)[..., 0]
    largest_other = logits.scatter(-1, compared_class, -torch.inf).amax(-1)
    difference = compared_logit - largest_other
    return torch.where(has_target, difference, -difference)


def complementary_label(label: int) -> int:
    """Return the complementary label of a class. It says that images do not show the class."""
    return -1 - label


def require_known(labels: Int[Tensor, " N"], logits: Float[Tensor, "_ classes"]) -> None:
    """Check that every label has a logit. Labels may be complementary."""
    require_range("label", int(_class_of(labels).amax()), 0, logits.shape[1] - 1)


def label_loss(
    logits: Float[Tensor, "N classes"],
    labels: Int[Tensor, " N"],
    label_smoothing: float = 0.0,
    absent: Sequence[int] = (),
) -> Float[Tensor, " N"]:
    """Compute the loss of each image by its label.

    An image of class c has the label c. Its loss is the cross entropy. An image that does not
    show class c has the complementary label −1 − c. Its loss is −log(1 − p), where p is the sum
    of the probabilities of c and of the classes `absent`.
    """
    classes = _class_of(labels)
    # Set the logits of the classes that are not shown to -∞. Only the logits of the other
    # classes remain.
    other_logits = logits.scatter(1, classes[:, None], -torch.inf)
    for index in absent:
        other_logits[:, index] = -torch.inf
    # The other classes have the probability Σ exp(other_logits) / Σ exp(logits) = 1 - p.
    complementary = logits.logsumexp(1) - other_logits.logsumexp(1)
    cross_entropy = F.cross_entropy(
        logits, classes, reduction="none", label_smoothing=label_smoothing
    )
    return torch.where(labels < 0, complementary, cross_entropy)


def log_odds(logits: Float[Tensor, "N classes"], label: int) -> Float[Tensor, " N"]:
    """Compute the log-odds of a class, log(p / (1 − p)), where p is its probability.

    The result is finite even if p rounds to 0 or 1.
    """
    others = torch.cat([logits[:, :label], logits[:, label + 1 :]], dim=1)
    return logits[:, label] - others.logsumexp(dim=1)


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


def is_correct(
    predicted: Int[Tensor, " N"], labels: Int[Tensor, " N"], absent: Sequence[int] = ()
) -> Bool[Tensor, " N"]:
    """Return a mask of the predictions that agree with the labels.

    A label that is a class demands the prediction of this class. The complementary label
    −1 − c says that the image does not show class c. It demands a prediction that is neither c
    nor one of the classes `absent`.
    """
    is_complementary = labels < 0
    is_class_of_label = predicted == _class_of(labels)
    is_absent = torch.zeros_like(is_class_of_label)
    for index in absent:
        is_absent = is_absent | (predicted == index)
    return torch.where(
        is_complementary,
        ~is_class_of_label & ~is_absent,
        is_class_of_label,
    )


def _class_of(labels: Tensor) -> Tensor:
    """Return the class c of each label, which is c or, if it is complementary, −1 − c."""
    return torch.where(labels < 0, -1 - labels, labels)
