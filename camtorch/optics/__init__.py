"""What a camera model is made of: charts (ray to plane) and lenses (plane to plane), with their derivatives."""
