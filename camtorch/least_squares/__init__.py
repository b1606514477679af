"""Nonlinear least squares: the method of Levenberg and Marquardt, and the Jacobians of charts and lenses for it."""
