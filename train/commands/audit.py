"""pnb-audit: how safe a network is in unusual lighting."""

from train.auditing.audit import run_audit
from train.command_settings import AuditSettings


def audit(settings: AuditSettings) -> None:
    """Run the audit of pnb-audit, and print its answer, its numbers and the path of its report."""
    audited = run_audit(settings)
    print(audited.screen)
    print(f"report: {audited.path}")
