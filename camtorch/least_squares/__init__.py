"""Nonlinear least squares: the Levenberg-Marquardt method, and the Jacobians of charts and lenses for it."""
