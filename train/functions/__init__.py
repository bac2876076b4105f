"""What Python callers do with a network: load, evaluate, audit and harden it."""
