"""Classifier and scenes to labelled images. Knows no OpenGL, no optimiser and no data set."""
