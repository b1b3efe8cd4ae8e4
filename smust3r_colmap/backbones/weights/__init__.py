"""Weights that others publish: what there is, fetching it, and finding it again.

``catalogue`` knows the official files and their licence, ``cache`` where they lie and which one a
run takes, ``checksum`` whether a file is as published, ``download`` how it comes over the network.
Nothing is ever fetched by a reconstruction: only ``smust3r-colmap weights fetch`` does, after
consent.
"""
