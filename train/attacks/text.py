"""An attack's outcome as text for the terminal."""

from collections.abc import Sequence

from torch import Tensor

from augment.attacks.adversary import Adversary
from augment.attacks.attack import AttackResult
from augment.attacks.evaluate import Checks, RerenderCheck
from train.tables import format_fraction, fraction


def format_attack(
    mesh: str, attacked: AttackResult, checks: Checks | None, rerender_checks: Sequence[RerenderCheck] = ()
) -> str:
    """A paragraph on one mesh's attack, without a newline at the end."""
    kinds = "+".join(kind.name for kind in attacked.problem.parameters)
    steps = attacked.steps[attacked.success & ~attacked.success_before].double()
    lines = [
        f"{mesh}: {kinds} against {attacked.classifier.name}: {_success(attacked)}"
        + (f"; median of {steps.median():.0f} steps" if len(steps) else "")
        + f" ({attacked.seconds['attack']:.1f} s)"
    ]
    if checks is not None:
        by_steps = ", ".join(f"{share:.0%} in {steps}" for steps, share in checks.success_by_steps.items())
        lines += [
            f"cost {checks.cost_before:.2f} before and {checks.cost:.2f} after; it fell in {checks.cost_fell:.0%}; "
            f"first gradients that are zero: {checks.zero_gradient:.0%}",
            f"success of as many random draws: {checks.random_search:.0%}; by longer attacks: {by_steps} steps",
            *(f"warning: {warning}" for warning in checks.warnings),
        ]
    success = attacked.success & attacked.clean_correct
    lines += [_survival(rerender_check, success) for rerender_check in rerender_checks if success.any()]
    return "\n".join(lines)


def _survival(rerender_check: RerenderCheck, success: Tensor) -> str:
    """How many of the adversaries succeed in another version, and how far its values are from theirs, of 255."""
    largest, mean = 255 * rerender_check.largest[success].max(), 255 * rerender_check.mean[success].mean()
    survivors = int(rerender_check.success[success].sum())
    return (
        f"{rerender_check.version}: {survivors} of {int(success.sum())} still succeed; "
        f"values differ by {mean:.3g}/255 on average, {largest:.3g}/255 at most"
    )


def _success(attacked: AttackResult) -> str:
    """On examples that were correct before, and on their views, with the 95 % Wilson interval."""
    clean_correct = attacked.clean_correct
    result = fraction(int(attacked.success[clean_correct].sum()), int(clean_correct.sum()))
    if not result["n"]:
        return f"none of {len(clean_correct)} examples was correct before: there is nothing to count"
    text = f"success on {format_fraction(result)} examples"
    if attacked.success_in_views.shape[1] > 1:
        views = attacked.success_in_views[clean_correct]
        text += f", {int(views.sum())} of {views.numel()} views"
    wrong = int((~clean_correct).sum())
    return text + (f"; {wrong} wrong before, which do not count" if wrong else "")


def format_reloaded(adversary: Adversary, images: Tensor, logits: Tensor, classes: Sequence[str]) -> str:
    """A line per view: what an adversary's images (V, 3, size, size), rendered anew, are taken for by logits (V, C)."""
    best = logits.softmax(1).max(1)
    off = 255 * (images - adversary.images.to(images)).abs().flatten(1).amax(1)
    return "\n".join(
        f"view {view}: {adversary.shown.label} is taken for {classes[index]} ({confidence:.1%}); "
        f"values differ from the saved image's by {largest:.3g}/255 at most"
        for view, (index, confidence, largest) in enumerate(
            zip(best.indices.tolist(), best.values.tolist(), off.tolist(), strict=True)
        )
    )
