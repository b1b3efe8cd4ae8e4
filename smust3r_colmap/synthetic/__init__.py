"""Scenes with exactly known cameras, and a backbone simulated from them."""
