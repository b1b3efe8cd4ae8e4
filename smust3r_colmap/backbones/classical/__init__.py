"""The backbone without weights: SIFT and mapping by pycolmap, depth by plane sweep."""
