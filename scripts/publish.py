"""pnb-publish: write the network of a run as half-precision safetensors."""

from train.command import Command
from train.command_settings import PublishSettings
from train.help import HelpText

main = Command(
    name="publish",
    settings=PublishSettings,
    body="train.commands.publish:publish_network",
    help=HelpText(
        about="Write the network of a run as half-precision safetensors.\n\n"
        "The metadata of the file holds the settings and the scores of the run as JSON.",
        examples=[
            "pnb-publish run=runs/a out=published/a",
            "pnb-publish run=published/a out=published/a calibrate=lab false_positive_rate=0.05",
        ],
    ),
)

if __name__ == "__main__":
    main()
