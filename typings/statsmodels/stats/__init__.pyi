# What this project imports, since pyright would take minutes to infer it from the source: add what you need.
