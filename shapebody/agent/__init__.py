"""Trained agents, in memory and on disk."""
