"""A page that shows any lens live: `camtorch.write_viewer`."""
