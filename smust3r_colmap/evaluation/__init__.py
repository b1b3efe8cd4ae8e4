"""Trajectories against ground truth, and readers of ground truth."""
