"""The renderer's time against its error: scenes and reference, clocks, panels, Mitsuba, targets, page."""
