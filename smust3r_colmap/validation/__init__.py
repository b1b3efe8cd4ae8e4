"""Whether a COLMAP model is sound, and which of its readers would refuse it.

A reader of this package begins with ``validate``, its table of contents: the files are parsed into a ``description``
(arrays, no open files), every rule checks it (``checks_*``, joined in ``validate.RULES``), and ``readers`` lists which
rule affects which program.
"""
