"""What a design is worth: returns, recordings, statistics."""
