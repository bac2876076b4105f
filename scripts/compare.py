"""Print a Markdown table of finished runs. With -v, print all tables."""

from train.cli import Command

main = Command(
    name="compare",
    settings="train.command_settings:CompareSettings",
    about=__doc__,
    examples=["pnb-compare 'runs=[runs/a,runs/b]'"],
)

if __name__ == "__main__":
    main()
