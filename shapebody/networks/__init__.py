"""The URMA networks: policy and critics (Section 3.1, eq. 3).

To be read in this order: inputs, config, urma (the encoder that both share), policy, critic.
"""
