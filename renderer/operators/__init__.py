"""Light between surfaces: rays among them, shadows and bounces, folded into operators."""
