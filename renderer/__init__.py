"""Scene to pixels, and pixel gradients to scene parameters. Knows no classifier and no data set."""
