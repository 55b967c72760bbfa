"""A running session estimates the errors that all measurements share, such as clock offsets. Then it corrects its map."""
