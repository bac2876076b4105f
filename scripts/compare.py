"""Print a Markdown table of finished runs. With -v, print all tables."""

from train.cli import Command

examples = ["pnb-compare 'runs=[runs/a,runs/b]'"]
main = Command("compare", "train.command_settings:CompareSettings", __doc__, examples)

if __name__ == "__main__":
    main()
