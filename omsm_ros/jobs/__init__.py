"""One whole task a file, shared by commands and nodes."""
