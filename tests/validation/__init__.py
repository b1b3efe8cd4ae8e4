"""A package, so that its conftest and its files may have names that other rooms have, too."""
