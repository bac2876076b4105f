"""`python -m scripts NAME ...` calls a command in a clone."""

import sys

import scripts
from train.cli import Command

commands = {name: value for name, value in vars(scripts).items() if isinstance(value, Command)}
name = sys.argv.pop(1) if len(sys.argv) > 1 else ""
if name not in commands:
    sys.exit(f"error: {name} is not a command: choose one of {', '.join(commands)}")
commands[name]()
