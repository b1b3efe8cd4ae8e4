"""What reconstructs one segment alone. ``base`` has the protocol, each backbone a package of its own."""
