"""What follows from rays: fields, depth, lines, fields of view, why a point has no pixel."""
