"""The locomotion task (Appendix A): observations, rewards, curriculum, episodes."""
