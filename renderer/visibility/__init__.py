"""Visible surfaces: rasterizers, the samples of each face, and silhouette edges."""
