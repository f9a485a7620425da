"""Parts that scene families are made of: values and plain functions, one module for each section of a family file.

`vary`: what varies, a parameter and its range in one line. `stage`: a world with a way through it; `ramp`, `dominoes`
and `board`: what stands on some stages. `outcome`: labels and margin of a run. `questions`: what is asked, and what
even the void answers. `observers`: what is seen of the answer. `family`: all of it put together for the registry.
"""
