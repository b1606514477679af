"""The evaluation of every camera: both directions, their derivatives, and where they are valid."""
