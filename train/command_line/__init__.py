"""The entry points: configurations composed and read, errors in one sentence, outputs tried before the work."""
