"""What is said about a finished run."""
