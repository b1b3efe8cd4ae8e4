"""Published weights: the catalogue, fetching them, and the cache.

``catalogue`` knows the official files and their licence, ``cache`` where they lie and which one a run takes,
``checksum`` whether a file is as published, ``download`` how it comes over the network. A reconstruction never
downloads anything: only ``smust3r-colmap weights fetch`` does, after the licence was accepted.
"""
