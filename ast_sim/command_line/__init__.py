"""The commands of the command line: what they do, and lines that end their help."""
