"""pnb-audit: how safe a network is in unusual lighting."""

from train.auditing.audit import run_audit
from train.command_settings import AuditSettings


def audit(settings: AuditSettings) -> None:
    """Test a network in unusual lighting, and print the main numbers and the path of the report."""
    audited = run_audit(settings)
    print(audited.screen)
    print(f"report: {audited.path}")
