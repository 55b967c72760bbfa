"""A live session estimates the errors that all measurements share while it runs. It then corrects its map."""
