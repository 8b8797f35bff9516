"""PPO over randomized designs, and policy evaluation (Section 3.1, Appendix A)."""
