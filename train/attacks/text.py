"""An attack's outcome as text for the terminal."""

from collections.abc import Sequence

from torch import Tensor

from augment.attacks.adversary import Adversary
from augment.attacks.checks import Checks
from augment.attacks.run import Attacked
from augment.attacks.verification import Verdict
from train.photographs.shares import share


def format_attack(mesh: str, attacked: Attacked, checks: Checks | None, verdicts: Sequence[Verdict] = ()) -> str:
    """A paragraph on one mesh's attack, without a newline at the end."""
    result = attacked.result
    kinds = "+".join(kind.name for kind in attacked.problem.kinds)
    steps = result.steps[result.fooled & ~result.fooled_before].double()
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
            f"fooled by as many random draws: {checks.random_search:.0%}; by longer attacks: {by_steps} steps",
            *(f"warning: {warning}" for warning in checks.warnings),
        ]
    fooled = attacked.success & attacked.recognised
    lines += [_survival(verdict, fooled) for verdict in verdicts if fooled.any()]
    return "\n".join(lines)


def _survival(verdict: Verdict, fooled: Tensor) -> str:
    """How many of the adversaries fool in another version, and how far its values are from theirs, of 255."""
    largest, mean = 255 * verdict.largest[fooled].max(), 255 * verdict.mean[fooled].mean()
    return (
        f"{verdict.version}: {int(verdict.fooled[fooled].sum())} of {int(fooled.sum())} still fool; "
        f"values differ by {mean:.3g}/255 on average, {largest:.3g}/255 at most"
    )


def _success(attacked: Attacked) -> str:
    """Among what was recognised before the attack, in examples and in views, with the 95 % Wilson interval."""
    recognised = attacked.recognised
    found = share(int(attacked.success[recognised].sum()), int(recognised.sum()))
    if not found["n"]:
        return f"none of {len(recognised)} examples was recognised before: there is nothing to count"
    text = "{hits} of {n} examples fooled [{low:.0%}, {high:.0%}]".format(**found)
    if attacked.success_in_views.shape[1] > 1:
        views = attacked.success_in_views[recognised]
        text += f", {int(views.sum())} of {views.numel()} views"
    wrong = int((~recognised).sum())
    return text + (f"; {wrong} not recognised before, which do not count" if wrong else "")


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
