"""The machine: devices, processes, and errors that a user can fix."""
