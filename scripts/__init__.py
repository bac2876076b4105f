"""The commands.

A command is called with `python -m scripts.NAME` in a clone. Once the project is
installed, this package is `pnb_scripts`, and the command is `pnb-NAME`.
"""
