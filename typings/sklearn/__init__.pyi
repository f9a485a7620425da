# The names that this project uses, with their types: to infer them from the source takes pyright minutes.
