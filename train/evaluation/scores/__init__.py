"""The scores of a network on photographs."""
