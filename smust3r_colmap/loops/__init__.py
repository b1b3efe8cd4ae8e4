"""Loops: finding places that the camera came back to, and the segments that close them (paper section III-F).

``detection`` compares image descriptors, ``planning`` chooses the loops and cuts their segments,
``verification`` believes a reconstructed loop or not.
"""
