"""Images from one camera to another."""
