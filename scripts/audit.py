"""Is a classifier safe in strange light, and what does hardening cost? pnb-audit classifier=NAME out=audit

An audit that was stopped goes on with the same settings, and with hardened= or photos= besides, if it had none.
"""

import sys

sys.path[0] = sys.path[0].removesuffix("/scripts")  # in a clone, packages are found in its root
from train import cli  # isort: skip (first, since the others take seconds to import)

from train.audit.audit import AuditSettings, run_audit


@cli.command()
def main(settings: AuditSettings) -> None:
    print(f"report: {run_audit(settings)}")


if __name__ == "__main__":
    main()
