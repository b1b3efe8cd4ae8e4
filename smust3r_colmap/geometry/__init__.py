"""Pure geometry on arrays: no files, no settings, no clocks. Start with ``transform``."""
