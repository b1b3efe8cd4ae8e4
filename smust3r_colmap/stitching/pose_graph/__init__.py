"""Segments joined by measured transforms, solved together: start with ``optimise``, on a ``graph.PoseGraph``."""
