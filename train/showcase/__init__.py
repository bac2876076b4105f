"""A report to look at: runs and attacks, read from their folders, as one page of HTML and as Markdown."""

from train.showcase.write import report_of, write_report

__all__ = ["report_of", "write_report"]
