"""Share parts of scene families: a module for each section of a family's file.

`vary`: what varies, a parameter and its range in one line. `course`: a world with a way through it; `ramp`, `dominoes`
and `board`: what stands on some courses. `readings`: labels and margin of a run. `questions`: what is asked, and what
even the void answers, in the templates of `wording`. `observers`: what is seen of the answer. `family`: all of it put
together for the registry.
"""
