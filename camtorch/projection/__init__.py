"""How every camera is evaluated: both directions, their derivatives, and where they are valid."""
