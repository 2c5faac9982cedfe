"""The command line: its verbs are imported when they are called."""
