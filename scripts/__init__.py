"""The commands: `python -m scripts.NAME` in a clone; `pnb-NAME` once installed, as the package pnb_scripts."""
