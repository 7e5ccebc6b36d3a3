"""The command line ``cab-forecast``: one module per command.

Each module defines its options at the top and imports torch, the client and the server inside its functions,
so that ``--help`` is quick. The work itself is done by the packages that a command calls.
"""
