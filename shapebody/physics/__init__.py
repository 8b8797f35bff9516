"""Two physics engines behind one protocol: MuJoCo in C, and MJX."""
