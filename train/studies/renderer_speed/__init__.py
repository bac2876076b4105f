"""A timer that other studies use."""
