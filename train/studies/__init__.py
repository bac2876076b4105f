"""What this project reports of itself, a package per page of docs/: each measures, and writes its page.

accuracy, interruptions, paper, renderer_speed, training_speed.
"""
