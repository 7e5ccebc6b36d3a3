"""The command line ``cab-forecast``: one module a command."""
