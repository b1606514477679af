"""The base of all packages: arguments, modules, threads."""
