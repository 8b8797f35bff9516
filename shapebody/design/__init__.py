"""The design space of a robot, and the design map Φ from a design to a body."""
