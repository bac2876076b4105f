"""pnb-compare: print a Markdown table of finished runs."""

from train.cli import Command

main = Command(
    name="compare",
    settings="train.commands.compare:CompareSettings",
    body="train.commands.compare:run",
    about="Print a Markdown table of finished runs. With -v, print all tables.",
    examples=["pnb-compare 'runs=[runs/a,runs/b]'"],
)

if __name__ == "__main__":
    main()
