"""Design search: VGDS, penalty only and the baselines (Sections 3.2 and 4.1)."""
