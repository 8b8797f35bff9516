"""The URMA networks: policy and critics (Section 3.1, eq. 3)."""
