"""The commands of the command line; `command_tree` assigns names to their functions."""
