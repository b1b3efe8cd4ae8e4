"""Cutting a collection into segments. ``windows`` follows the order of the images."""
