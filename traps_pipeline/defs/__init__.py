"""The DAG: one file a stage group. Assets read tables, call one library function, write a table; they know no science."""
