"""The commands of the command line; `command_tree` says which module has which."""
