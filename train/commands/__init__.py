"""The installed commands beside `pnb-train`: `pnb-NAME`, or `python -m train.commands.NAME` in a clone."""
