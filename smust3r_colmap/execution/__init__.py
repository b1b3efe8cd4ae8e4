"""How work runs, in this process or in children, and who is told about it."""
