"""The scanner software's own socket interface beside the twin's: a program written for it works."""
