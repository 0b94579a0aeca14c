"""A script on a virtual clock: its plan, the images it takes, and the dry run."""
