"""The commands: `python scripts/NAME.py` in a clone; `pnb-NAME` once installed, as the package pnb_scripts.

Python looks for modules in a script's own folder first. Each script therefore puts the clone's root in that place,
which does nothing in an installation.
"""
