"""The images that networks are trained and scored on."""
