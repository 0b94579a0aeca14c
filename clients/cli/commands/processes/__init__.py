"""Commands that start processes or look at this installation: servers, demonstration, checks."""
