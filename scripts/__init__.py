"""The commands besides pnb-train, and what --help says about them.

`python -m scripts.NAME` calls a command in a clone. Once the project is installed, this package is
`pnb_scripts`, and the command is `pnb-NAME`.
"""
