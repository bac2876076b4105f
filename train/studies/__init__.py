"""What this project reports of itself, a package per page of docs/: each measures, and writes its page."""
