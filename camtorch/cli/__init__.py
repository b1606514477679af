"""The command `camtorch`."""
