"""What camtorch says where something is wrong."""
