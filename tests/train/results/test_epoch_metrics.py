"""The metrics of an epoch."""

import pytest

from train.run_folder import attack_success


def test_attack_success_is_the_fraction_of_the_clean_correct_examples():
    """Of ten examples, two were wrong before, and six are wrong after the attack."""
    diagnostics = {"attack_success_before": 0.2, "attack_success": 0.6}
    assert attack_success(diagnostics) == pytest.approx(4 / 8)


@pytest.mark.parametrize("diagnostics", [{}, {"attack_success_before": 1.0, "attack_success": 1.0}])
def test_there_is_no_attack_success_without_clean_correct_examples(diagnostics):
    assert attack_success(diagnostics) is None
