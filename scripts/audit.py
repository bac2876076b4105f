"""pnb-audit: measure how safe a classifier is in unusual lighting, and what hardening costs."""

from train.command import Command
from train.command_settings import AuditSettings
from train.help import HelpText

main = Command(
    name="audit",
    settings=AuditSettings,
    body="train.commands.audit:audit",
    help=HelpText(
        about="Measure how safe a classifier is in unusual lighting, and what hardening costs.\n\n"
        "An audit that was stopped continues with the same settings, and with hardened= or photos= "
        "in addition.",
        examples=[
            "pnb-audit classifier=NAME meshes=[orange.glb] look_alikes=[solid:lemon] out=audit",
        ],
    ),
)

if __name__ == "__main__":
    main()
