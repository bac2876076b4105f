"""What a camera sees: rasterizers, the samples of each face, and the edges of what is seen."""
