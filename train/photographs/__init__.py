"""Real photographs: find them in a folder, reduce them to the classifier's size, and score its predictions."""
