"""A camera as a camera of another model."""
