"""The DAG: one file a stage group. Assets read tables, call a library function, write a table."""
