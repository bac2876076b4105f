"""The tables and figures of the paper, measured here, a module per section of docs/paper.md."""
