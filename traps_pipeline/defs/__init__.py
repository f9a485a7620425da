"""The DAG: one file per group of stages. An asset reads tables, calls a library function and writes a table."""
