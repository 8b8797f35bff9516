"""Design search: VGDS, its control and the baselines (Sections 3.2 and 4.1)."""
