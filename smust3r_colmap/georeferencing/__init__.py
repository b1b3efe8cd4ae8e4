"""From the world of a model to a place on earth: frame, similarity, control points, residuals."""
