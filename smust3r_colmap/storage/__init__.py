"""How products of stages lie on disk, and how they are found again."""
