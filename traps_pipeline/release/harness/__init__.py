"""The items of a release, its panel of rules and its metric for harnesses that others use.

`write.py` copies the other files of this folder, and the modules that they need, into a folder that needs nothing of
this package; so the panel there is this one, not a second one that resembles it.
"""
