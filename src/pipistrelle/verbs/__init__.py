"""What a person asks for at the command line, one module per verb, imported when it is called."""
