"""The commands besides pnb-train: their settings, and what each does."""
