"""Write a page of runs, sweeps and attacks."""

from train.cli import Command

examples = ["pnb-report runs=runs/sweep"]
main = Command("report", "train.command_settings:ReportSettings", __doc__, examples)

if __name__ == "__main__":
    main()
