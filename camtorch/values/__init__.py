"""What everybody uses: arguments, modules, threads."""
