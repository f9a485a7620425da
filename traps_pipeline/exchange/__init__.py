"""Exchange calls: export requests, batches and media; import answers and votes."""
