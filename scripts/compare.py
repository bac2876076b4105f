"""pnb-compare: print Markdown tables of finished runs."""

from train.cli import Command, HelpText
from train.commands.compare import CompareSettings

main = Command(
    name="compare",
    settings=CompareSettings,
    body="train.commands.compare:run",
    help=HelpText(
        about="Print a Markdown table of finished runs. With -v, print all tables.",
        examples=["pnb-compare 'runs=[runs/a,runs/b]'"],
    ),
)

if __name__ == "__main__":
    main()
