"""Python client, data set reader and command line."""
