"""Give other evaluation harnesses a release's items, rule panel and metric.

`write.py` copies the other files of this folder, and the modules that they need, into a self-contained folder; so the
panel there is this one, not a second one that resembles it.
"""
