"""Results from rays: fields, depth, lines, fields of view, and why a point has no pixel."""
