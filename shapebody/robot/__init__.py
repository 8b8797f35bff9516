"""A robot: its file read, completed, checked and described."""
