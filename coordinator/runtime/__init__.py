"""Event loop, exit codes and terminal of the command-line programs."""
